# %% [markdown]
# # A robot of your own
#
# To identify a machine you need a MuJoCo model, a log, and a list of what may differ.
# No environment has to be written. This notebook makes all three for a two-link arm and
# looks at the result: what the parameters are, how sure that is, and how well the
# identified model predicts a recording that took no part in the fit.
#
# The machine is played by MuJoCo C at a finer timestep, with other numbers than the
# model's and noisy encoders, so that the result can be checked. With your own robot,
# put your files in the place of `model`, `parameters` and the two logs
# (`docs/your_own_robot.md` says all about them).

# %%
import json
import os
from pathlib import Path

import matplotlib.pyplot as plt
import mujoco
import numpy as np

import train
from easi_jax.io.runs.metrics import read_metrics
from train import easi, parameters

# full: a minute or two on a laptop. tiny: to see that every cell runs.
TINY = os.environ.get("EASI_NOTEBOOK_SIZE", "full") == "tiny"
SECONDS = 10 if TINY else 20  # of each recording
GENERATIONS, POPULATION = (10, 64) if TINY else (50, 300)

OUT = Path("results/your_own_robot")
OUT.mkdir(parents=True, exist_ok=True)
EXAMPLES = Path(train.__file__).parents[1] / "examples"

# %% [markdown]
# ## The model, and what may vary in it
#
# `train.parameters` proposes what may vary in any MJCF. The proposal is a start: what
# you have measured or weighed should go out of the list. Motion alone cannot tell a
# heavy machine with strong motors from a light one with weak motors, so at least one
# mass or motor has to be trusted.
#
# The example's timestep of 5 ms is made finer first: what a coarse one does to quick
# motion would end up in the damping (4 % too much at the shoulder) and in the error on
# held-out data.

# %%
spec = mujoco.MjSpec.from_file(str(EXAMPLES / "my_robot" / "model.xml"))
spec.option.timestep = 0.001
model = OUT / "arm.xml"
model.write_text(spec.to_xml())
parameters.run(
    parameters.Config(model=model, out=OUT / "proposed.yaml", overwrite=True)
)

# %% [markdown]
# Here the upper arm was weighed and the elbow's motor comes with a good data sheet; the
# lower arm carries a tool of unknown mass, and nobody knows the damping. `initial` is
# where the search starts, `bounds` is what physics allows: a wrong start can be left.

# %%
(OUT / "parameters.yaml").write_text("""parameters:
  - name: lower_mass
    address: body.lower.mass
    initial: [0.1, 0.6]
    bounds: [0.01, 5.0]
    unit: kg
  - name: shoulder_damping
    address: joint.shoulder.damping
    initial: [0.005, 0.2]
    bounds: [0.0001, 5.0]
    unit: N m s/rad
  - name: elbow_damping
    address: joint.elbow.damping
    initial: [0.005, 0.2]
    bounds: [0.0001, 5.0]
    unit: N m s/rad
  - name: shoulder_gear
    address: actuator.shoulder.gear
    initial: [1.5, 6.0]
    bounds: [0.1, 50.0]
    unit: N m
""")
truth = {
    "lower_mass": 0.29,
    "shoulder_damping": 0.06,
    "elbow_damping": 0.035,
    "shoulder_gear": 2.4,
}

# %% [markdown]
# ## The logs
#
# A log is a table with a row per control step: `time` [s], `qpos.JOINT` [rad], and
# `ctrl.ACTUATOR`, the command that was *sent* from that row to the next. Velocities are
# optional. Move as the robot will be used, with reversals and quick changes; and record
# a second run to check with.

# %%
CONTROL_STEP, FINE_STEPS = 0.01, 20  # s; physics steps of the machine in it
NOISE = 2e-4  # rad, of an encoder

spec = mujoco.MjSpec.from_file(str(model))
spec.option.timestep = CONTROL_STEP / FINE_STEPS
spec.body("lower").geoms[0].mass = truth["lower_mass"]
spec.joint("shoulder").damping[0] = truth["shoulder_damping"]
spec.joint("elbow").damping[0] = truth["elbow_damping"]
spec.actuator("shoulder").gear[0] = truth["shoulder_gear"]
simulator = spec.compile()


def record(path, wanted, rng):
    """Plays the machine under a PD controller that wants angles ``(T, 2)`` [rad]."""
    data = mujoco.MjData(simulator)
    data.qpos[:] = before = wanted[0]
    rows = []
    for t, goal in enumerate(wanted):
        measured = data.qpos + NOISE * rng.standard_normal(2)
        speed = (measured - before) / CONTROL_STEP
        before = measured
        command = np.array([2.0, 1.5]) * (goal - measured) - 0.05 * speed
        data.ctrl[:] = np.clip(command, -1, 1)
        rows.append([CONTROL_STEP * t, *measured, *data.ctrl])
        mujoco.mj_step(simulator, data, FINE_STEPS)
    head = "time,qpos.shoulder,qpos.elbow,ctrl.shoulder,ctrl.elbow"
    np.savetxt(path, rows, fmt="%.7g", delimiter=",", header=head, comments="")
    return np.array(rows)


rng = np.random.default_rng(0)
time = np.arange(0, SECONDS, CONTROL_STEP)
sweep = [np.pi + 1.2 * np.sin(0.3 * time**1.4), 1.2 * np.sin(2.1 * time)]
poses = np.array([[np.pi, 0.0], [2.2, 0.8], [3.8, -0.9], [2.8, 1.2]])
at = 1.5 * np.arange(len(poses))  # s
moves = [np.interp(time, at, q, period=6.0) for q in poses.T]
recorded = record(OUT / "sweep.csv", np.transpose(sweep), rng)
record(OUT / "moves.csv", np.transpose(moves), rng)
print(*(OUT / "sweep.csv").read_text().splitlines()[:4], sep="\n")

fig, axes = plt.subplots(2, 1, figsize=(8, 4), sharex=True, layout="constrained")
axes[0].plot(recorded[:, 0], recorded[:, 1:3], label=["shoulder", "elbow"])
axes[0].set(xlabel="time [s]", ylabel="joint angle [rad]")
axes[1].plot(recorded[:, 0], recorded[:, 3:], label=["shoulder", "elbow"])
axes[1].set(xlabel="time [s]", ylabel="command [share of range]")
axes[0].legend()
plt.show()

# %% [markdown]
# ## The search
#
# One command: it estimates the sensor noise, searches adversarially on short pieces of
# the first log, finishes with least squares, and tests the result on the second log,
# which it has not looked at before. Its folder holds a report for people and
# `distribution.json` for programs.

# %%
easi.run(
    easi.Config(
        model=model,
        parameters=OUT / "parameters.yaml",
        data=(OUT / "sweep.csv",),
        held_out=(OUT / "moves.csv",),
        out=OUT / "run",
        generations=GENERATIONS,
        population=POPULATION,
        overwrite=True,
    )
)
found = json.loads((OUT / "run" / "distribution.json").read_text())
names = [p["name"] for p in found["parameters"]]
units = [p["unit"] for p in found["parameters"]]
result = found["seeds"]["0"]

# %% [markdown]
# Mean and spread of each parameter over the generations; the dashed line is the truth,
# which the search never sees. Where data determine a parameter, the band shrinks onto
# it.

# %%
lines = read_metrics(OUT / "run" / "metrics.jsonl", "search")
fig, axes = plt.subplots(1, len(names), figsize=(12, 2.8), layout="constrained")
for axis, name, unit in zip(axes, names, units, strict=True):
    mean, std = (
        np.array([line[f"seed0/{name}/{what}"] for line in lines])
        for what in ("mean", "std")
    )
    generation = [line["step"] for line in lines]
    factor = np.exp(2 * std / mean)  # searched on a logarithmic scale
    axis.fill_between(generation, mean / factor, mean * factor, alpha=0.2)
    axis.plot(generation, mean)
    axis.axhline(truth[name], color="black", ls="--", lw=1)
    axis.set(xlabel="generation", ylabel=f"{name} [{unit}]", yscale="log")
plt.show()

# %% [markdown]
# ## The result, and how sure it is
#
# The answer is a distribution. Its standard deviations come from the data's Fisher
# information, and its correlations belong to it: two parameters may be uncertain one by
# one and sure together. A policy is trained under draws from all of it. What the data
# do not determine is flagged, and must not be believed. The spread counts the noise and
# how well pieces fit, not everything that a model can get wrong: a timestep that is
# still coarser than the machine's moves the values by more than these small bars.

# %%
nominal = np.array([p["nominal"] for p in found["parameters"]])
mean, std = np.array(result["mean"]), np.array(result["std"])
true = np.array([truth[name] for name in names])
for row in zip(names, mean, std, true, units, result["flags"], strict=True):
    print("{:17} {:.4g} ± {:.2g} (truth {:g}) {}, {}".format(*row))

cov = np.array(result["unit_covariance"])
correlation = cov / np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
fig, axes = plt.subplots(1, 2, figsize=(10, 3.4), layout="constrained")
place = np.arange(len(names))
axes[0].errorbar(
    100 * (mean / true - 1), place, xerr=200 * std / true, fmt="o", label="found"
)
axes[0].plot(100 * (nominal / true - 1), place, "x", label="model as given")
axes[0].axvline(0, color="black", ls="--", lw=1)
axes[0].set(xlabel="deviation from the truth [%] (bars: two std)", ylabel="parameter")
axes[0].set_yticks(place, names)
axes[0].legend()
image = axes[1].imshow(correlation, cmap="RdBu_r", vmin=-1, vmax=1)
axes[1].set(xlabel="parameter", ylabel="parameter")
axes[1].set_xticks(place, names, rotation=30, ha="right")
axes[1].set_yticks(place, names)
fig.colorbar(image, ax=axes[1], label="correlation [-]")
plt.show()

# %% [markdown]
# ## The test that counts
#
# On a real machine there is no truth to compare with, but there is a held-out log. The
# noise floor is the error that a perfect model would have, from the encoders' noise in
# the start of each prediction. If the identified model is far above it, the model lacks
# something that no listed parameter can express: `gap_on_a_log` goes on from there.

# %%
held = found["held_out"]
errors = {
    "model as given": held["before"],
    "identified": held["after"]["0"],
    "noise floor": held["noise_floor"],
}
fig, axis = plt.subplots(figsize=(6, 3), layout="constrained")
for i, (label, values) in enumerate(errors.items()):
    axis.bar(np.arange(2) + 0.25 * i, np.multiply(values, 1000), 0.25, label=label)
    print(f"{label:15}", *(f"{1000 * x:8.3f} mrad" for x in values))
axis.set_xticks(np.arange(2) + 0.25, held["channels"])
axis.set(
    xlabel="joint",
    ylabel=f"error over {held['horizon']:g} s [mrad]",
    yscale="log",
)
axis.legend()
plt.show()

# %% [markdown]
# To train a policy for the identified arm, write its task as one Python file
# (`examples/my_robot/env.py`) and give it to `train.udr --env` and `train.easi --env`.
# `examples/lift_arm` is a set of files with dry friction and limits of the joints.
