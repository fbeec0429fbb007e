"""What force a law that was found adds, against what, for a picture."""

from collections.abc import Sequence

import mujoco
import numpy as np

from easi_jax.data.law_states import known_rows, term_path
from easi_jax.data.recording import Run
from easi_jax.model.found_laws import FoundLaw, law_of
from easi_jax.model.joint_space import tangent_units
from easi_jax.model.law_terms import Known
from easi_jax.model.own_laws import names_alone
from easi_jax.model.results import GapResult, LawCurve


def law_curves(r: GapResult, m: mujoco.MjModel, runs: Sequence[Run]) -> list[LawCurve]:
    """One for each law, over all rows of some runs."""
    laws = [(e, law) for e in r.effects if (law := law_of(e.effect)) is not None]
    if not laws:
        return []
    names = names_alone(m)
    rows = [(known_rows(names, run), run.dt) for run in runs]
    out = []
    for e, law in laws:
        values = [e.values[n][0] for n in law.numbers]
        force = [_force(law, values, known, dt) for known, dt in rows]
        against, x = _against(law, m, [known for known, _ in rows])
        out.append(LawCurve(e.law, against, x, np.concatenate(force), e.force_unit))
    return out


def _force(
    law: FoundLaw, values: Sequence[float], known: Known, dt: float
) -> np.ndarray:
    total = np.zeros(np.shape(known.time))
    for value, term in zip(values, law.terms, strict=True):
        total = total + value * term_path(term, known, dt)
    return total


def _against(
    law: FoundLaw, m: mujoco.MjModel, rows: Sequence[Known]
) -> tuple[str, np.ndarray]:
    """The position, speed or command that a law is about, of two joints their sum or
    difference, else the time; with its unit."""
    first = law.terms[0]
    kinds = [
        k for k in ("ctrl", "qpos", "qvel") if k in {kind for kind, _ in first.names}
    ]
    if not kinds:
        return "time [s]", np.concatenate([np.asarray(k.time) for k in rows])
    kind = kinds[0]
    about = sorted(name for k, name in first.names if k == kind)
    share = dict(law.acts) if {*about} == {j for j, _ in law.acts} else {about[0]: 1.0}
    x = [
        sum(s * np.asarray(getattr(k, kind)[j]) for j, s in share.items()) for k in rows
    ]
    label = " ".join(
        f"{'' if i == 0 else '+ ' if s > 0 else '- '}{kind}.{j}"
        for i, (j, s) in enumerate(share.items())
    )
    unit = ""
    if kind != "ctrl":
        length = tangent_units(m)[int(m.jnt_dofadr[m.joint(about[0]).id])]
        unit = f" [{length}/s]" if kind == "qvel" else f" [{length}]"
    return f"{label}{unit}", np.concatenate(x)
