"""Identify the lift arm from its logs: python examples/ten_lines.py"""

import easi_jax as ej

arm = ej.read_model("examples/lift_arm/model.xml")
what = ej.read_parameters("examples/lift_arm/parameters.yaml", arm)
log = ej.read_log("examples/lift_arm/sweep.csv", arm)
other = ej.read_log("examples/lift_arm/moves.csv", arm)
found = ej.estimate_parameters(arm, what, log, held_out=other)
print(found)
ej.export_model(found, "examples/lift_arm/model.xml", "results/arm")
lacks = ej.find_effects(arm, log, parameters=what, held_out=other)
print(lacks.verdict, [effect.label for effect in lacks.effects])
