"""The report of a search whose pseudo-real target is known."""

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from easi_jax.io.report.figures import returns_by_method, returns_by_step
from easi_jax.io.report.html import Picture, Report, Table
from easi_jax.io.report.numbers import number
from easi_jax.io.report.parameters import doubtful, lost, parameter_rows, unseen_notes
from easi_jax.io.report.video import FRAMES, render, strip
from easi_jax.model.parameters import ParameterSpace
from easi_jax.model.results import SeedResult, Shares, Transfer


def easi_report(
    space: ParameterSpace,
    seeds: Sequence[int],
    result: SeedResult,
    truth: np.ndarray,
    transfer: Transfer,
    by_generation: str,
    **more: Any,
) -> Report:
    """What the search found and what its policies return.

    Args:
        result: of the first seed.
        truth: ``(n,)`` SI, NaN where unknown.
        by_generation: figure of the search, SVG.
        more: further fields of `Report`; pictures are added to those of here.
    """
    rows = parameter_rows(space, result, truth)
    returns = transfer.returns
    medians = {k: float(np.median(v)) for k, v in returns.items()}
    first = next(iter(returns))
    oracle = medians.get("Oracle")
    return Report(
        title=f"EASI on {transfer.robot}",
        headline=[
            f"In the target the EASI policy returns {medians['EASI']:.1f}, the {first} "
            f"policy it started from {medians[first]:.1f}"
            + (f", the Oracle {oracle:.1f}" if oracle is not None else "")
            + (
                f" (medians of {len(seeds)} seeds)."
                if len(seeds) > 1
                else " (one seed)."
            )
        ],
        parameters=rows,
        undetermined=unseen_notes(space, result),
        tables=[
            return_table(seeds, returns, transfer.episodes),
            _error_table(transfer.held_out),
        ],
        pictures=[
            *_pictures(transfer, by_generation, seeds[0]),
            *more.pop("pictures", ()),
        ],
        diagnostics=[lost(transfer.non_finite), doubtful(rows)],
        **more,
    )


def return_table(
    seeds: Sequence[int], returns: Mapping[str, np.ndarray], episodes: int
) -> Table:
    """Returns of each method, a column a seed."""
    return Table(
        "Return in the target",
        ("method", "median", *(f"seed {s}" for s in seeds)),
        [
            (name, f"{np.median(r):.1f}", *(f"{x:.1f}" for x in r))
            for name, r in returns.items()
        ],
        f"Deterministic policies, {episodes} episodes a seed.",
    )


def medians_of(errors: Shares) -> dict[str, dict[str, dict[str, float | None]]]:
    """Kind of error to model to channel: medians over seeds; None: not measured."""
    kinds = {"one_step": errors.one_step, "open_loop": errors.open_loop}
    return {
        kind: {
            model: {
                channel: float(x) if np.isfinite(x) else None
                for channel, x in zip(errors.channels, np.median(v, 0), strict=True)
            }
            for model, v in by_model.items()
        }
        for kind, by_model in kinds.items()
    }


def _error_table(errors: Shares) -> Table:
    shares = medians_of(errors)
    labels = {"one_step": "one step", "open_loop": "0.2 s"}
    cases = [(kind, model) for kind in labels for model in shares[kind]]

    def share(x: float | None) -> str:
        return "not measured" if x is None else f"{number(100 * x, 3)} %"

    return Table(
        "Prediction error on fresh motion of the target",
        ("channel", *(f"{labels[kind]}, {model}" for kind, model in cases)),
        [
            (channel, *(share(shares[kind][model][channel]) for kind, model in cases))
            for channel in errors.channels
        ],
        "RMS error as a share of the RMS motion, noise-free, pieces at a speed limit "
        "left out; median over seeds. Never searched on.",
    )


def _pictures(transfer: Transfer, by_generation: str, seed: int) -> list[Picture]:
    curves = {k: v for k, v in transfer.curves.items() if v[0]}
    steps = [
        Picture(
            "Return by training step",
            returns_by_step(curves),
            "Return in the target against training steps for each method",
            "As Fig. 5 of the paper: every seed thin, the median bold.",
            file="returns",
        )
    ]
    return [
        Picture(
            "Return by method",
            returns_by_method(transfer.returns),
            "Final return in the target of each method, a dot for each seed",
            file="methods",
        ),
        *(steps if curves else []),
        Picture(
            f"Parameters by generation (seed {seed})",
            by_generation,
            "Mean and spread of each parameter over the generations, with the true "
            "value as a dashed line",
            "As Fig. 4 of the paper: the adversarial search alone, before any "
            "refinement; band of two standard deviations.",
            file="parameters",
        ),
    ]


def motion_strip(
    model: mujoco.MjModel, dt: float, qpos: np.ndarray, method: str, notes: list[str]
) -> list[Picture]:
    """An episode ``qpos (T + 1, nq)`` as a strip of frames; ``notes`` say where they
    are drawn without OpenGL. ``dt`` [s] lies between positions."""
    qpos = np.asarray(qpos)
    moving = np.flatnonzero(np.any(np.diff(qpos, axis=0) != 0, axis=1))
    end = int(moving[-1]) + 1 if moving.size else 0
    chosen = np.linspace(0, end, FRAMES).round().astype(int)
    frames = render(model, qpos[chosen], 300, 200, limit=60, tell=notes.append)
    return [
        Picture(
            "An episode",
            strip(frames),
            f"Frames of an episode of the {method} policy in the target",
            f"{method} policy in the target: {FRAMES} moments of {end * dt:.1f} s.",
        )
    ]
