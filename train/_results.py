"""What a finished search leaves in its folder: numbers, figures, the report."""

from collections.abc import Mapping, Sequence
from typing import Any


def per_seed_json(seeds: Sequence[int], values: Any) -> dict[str, float]:
    """``{"0": value, ...}`` of one number a seed."""
    return {str(s): float(v) for s, v in zip(seeds, values, strict=True)}


def flags(space: Any, ident: Any, unit_mean: Any) -> list[str]:
    """``determined``, ``not determined`` or ``at bound`` for each parameter."""
    import numpy as np

    low, high = (np.asarray(b) for b in space.unit_bounds)
    width = 1e-3
    mean = np.asarray(unit_mean)
    at_bound = (mean <= low + width) | (mean >= high - width)
    return [
        "at bound" if b else "determined" if d else "not determined"
        for b, d in zip(at_bound, ident.determined, strict=True)
    ]


def seed_result(space: Any, unit_mean: Any, unit_cov: Any, hessian: Any) -> Any:
    """One seed's result as plain numbers, for ``distribution.json``."""
    import numpy as np

    from easi_jax.estimation.identifiability import describe, identifiability

    ident = identifiability(space, np.asarray(hessian))
    mean = np.asarray(space.to_si(unit_mean), float)
    std_unit = np.sqrt(np.diag(np.asarray(unit_cov, float)))
    above = np.asarray(space.to_si(np.asarray(unit_mean) + std_unit), float)
    below = np.asarray(space.to_si(np.asarray(unit_mean) - std_unit), float)
    return {
        "mean": mean.tolist(),
        "std": (0.5 * (above - below)).tolist(),
        "interval_68": np.stack([below, above], 1).tolist(),
        "unit_mean": np.asarray(unit_mean, float).tolist(),
        "unit_covariance": np.asarray(unit_cov, float).tolist(),
        "flags": flags(space, ident, unit_mean),
        "cramer_rao_std": [float(x) for x in ident.std],
        "determined_directions": ident.rank,
        "undetermined": [
            {"coefficients": d, "meaning": describe(d)} for d in ident.undetermined
        ],
    }


def distribution_json(
    space: Any, seeds: Sequence[int], results: Sequence[Any], **more: Any
) -> dict[str, Any]:
    """``distribution.json``: the parameters and what each seed found."""
    low, high = space.bounds
    first, last = space.initial
    head = [
        {
            "name": p.name,
            "addresses": list(p.addresses),
            "unit": p.unit,
            "nominal": float(p.nominal),
            "initial": [float(first[i]), float(last[i])],
            "bounds": [float(low[i]), float(high[i])],
            "scale": "log" if bool(space.log[i]) else "linear",
        }
        for i, p in enumerate(space.parameters)
    ]
    return {
        "schema": 1,
        "parameters": head,
        "coordinates": "unit: 0 and 1 are the ends of `initial`, on the scale named; "
        "samples are Gaussian in unit coordinates, clipped to `bounds`",
        "seeds": {str(s): r for s, r in zip(seeds, results, strict=True)},
        **more,
    }


def history_figure(
    folder: Any, space: Any, seed: int, truth: Any, generations: int
) -> str:
    """Parameters by generation of one seed, from the run's metrics (as Fig. 4)."""
    import numpy as np

    from easi_jax.io.report.figures import parameters_by_generation
    from easi_jax.io.runs.metrics import read_metrics

    lines = read_metrics(folder.path / "metrics.jsonl", "search")[:generations]
    low, high = space.initial
    start = np.asarray(space.to_si(np.full(space.size, 0.5)), float)
    above = np.asarray(space.to_si(np.full(space.size, 0.5 + 12**-0.5)), float)

    def column(what: str) -> Any:
        return np.array(
            [[line[f"seed{seed}/{n}/{what}"] for n in space.names] for line in lines]
        ).reshape(-1, space.size)

    return parameters_by_generation(
        np.vstack([start, column("mean")]),
        np.vstack([above - start, column("std")]),
        space.names,
        [p.unit for p in space.parameters],
        truth=truth,
        initial=np.stack([low, high], 1),
        log=[bool(x) for x in space.log],
    )


def _finite(values: Any) -> list[float | None]:
    return [float(x) if x == x else None for x in values]


def _share(x: float | None) -> str:
    return "not measured" if x is None else f"{100 * x:.2f} %"


def motion_strip(env: Any, qpos: Any, method: str, notes: list[str]) -> list[Any]:
    """An episode ``qpos (T + 1, nq)`` as a strip of frames; where nothing can be drawn,
    a note and no picture."""
    import numpy as np

    from easi_jax.errors import UserError
    from easi_jax.io.report.html import Picture
    from easi_jax.io.report.video import FRAMES, render, strip

    moving = np.flatnonzero(np.any(np.diff(np.asarray(qpos), axis=0) != 0, axis=1))
    end = int(moving[-1]) + 1 if moving.size else 0
    chosen = np.linspace(0, end, FRAMES).round().astype(int)
    try:
        frames = render(env.mj_model, np.asarray(qpos)[chosen], 300, 200, limit=60)
    except UserError as error:
        notes.append(f"no frames of the motion: {error}")
        return []
    return [
        Picture(
            "An episode",
            strip(frames),
            f"Frames of an episode of the {method} policy in the target",
            f"{method} policy in the target: {FRAMES} moments of {end * env.dt:.1f} s.",
        )
    ]


def truth_of(pipe: Any, theta: Any) -> Any:
    """True values ``(n,)`` of the search's parameters, from those of the real robot;
    what that lacks has no strength there."""
    import numpy as np

    from easi_jax.model.addresses import nominal

    real = pipe.real.space
    known = dict(zip(real.names, np.asarray(theta, float), strict=True))
    fixed = pipe.real.simulator.fixed
    out = []
    for p in pipe.space.parameters:
        value = known.get(p.name)
        if value is None and p.addresses[0].startswith("effect."):
            value = fixed.get(p.addresses[0])
            value = nominal(pipe.env.mj_model, p.addresses) if value is None else value
        out.append(np.nan if value is None else value)
    return np.array(out)


def write_pseudo_real(
    folder: Any,
    pipe: Any,
    estimate: Any,
    theta: Any,
    seeds: Sequence[int],
    returns: dict[str, Any],
    errors: dict[str, Any],
    curves: dict[str, Any],
    motion: Any,
    notes: Sequence[str],
    made_with: Mapping[str, Any],
) -> tuple[tuple[str, ...], list[tuple[Any, ...]]]:
    """Writes results, figures and report; returns the parameter table.

    ``motion (T + 1, nq)``: an episode of the EASI policy. ``made_with``: options of the
    robot and its effects, so that its policies can be loaded again. ``theta`` belongs
    to the robot that stands for the real one.
    """
    import numpy as np

    from easi_jax.io.report.figures import returns_by_method, returns_by_step
    from easi_jax.io.report.html import (
        Diagnostic,
        ParameterRow,
        Report,
        Table,
        write_report,
    )
    from easi_jax.io.runs.metrics import read_metrics
    from easi_jax.io.runs.versions import versions
    from easi_jax.rl.presets import algorithm_of

    space, config, notes = pipe.space, pipe.config, list(notes)
    theta = truth_of(pipe, theta)
    dist = estimate.distribution
    results = []
    for i in range(len(seeds)):
        root = np.asarray(dist.factor[i], np.float64)
        cov = root @ root.T
        results.append(seed_result(space, dist.mean[i], cov, estimate.hessian[i]))
    shares = {
        kind: {
            model: dict(zip(errors["channels"], _finite(np.median(v, 0)), strict=True))
            for model, v in errors[kind].items()
        }
        for kind in ("one_step", "open_loop")
    }
    folder.write_json(
        "distribution.json",
        distribution_json(
            space,
            seeds,
            results,
            truth=dict(zip(space.names, np.asarray(theta).tolist(), strict=True)),
            held_out=shares,
        ),
    )
    folder.write_json(
        "results.json",
        {
            "robot": pipe.env.name,
            "env": folder.config.get("env"),
            **made_with,
            "seeds": list(seeds),
            "env_steps": config.training.env_steps,
            "algorithm": algorithm_of(config.training),
            "methods": list(returns),
            "returns": {k: per_seed_json(seeds, v) for k, v in returns.items()},
            "held_out": shares,
        },
    )
    by_generation = history_figure(
        folder, space, seeds[0], theta, config.search.generations
    )
    known = {k: v for k, v in curves.items() if v[0]}
    steps = returns_by_step(known) if known else ""
    methods = returns_by_method(returns)
    for name, svg in (
        ("parameters", by_generation),
        ("returns", steps),
        ("methods", methods),
    ):
        if svg:
            folder.write(f"figures/{name}.svg", svg)
    best = results[0]
    low, high = space.initial
    bounds = space.bounds
    rows = [
        ParameterRow(
            name=p.name,
            addresses=p.addresses,
            unit=p.unit,
            initial=(float(low[i]), float(high[i])),
            mean=best["mean"][i],
            std=best["std"][i],
            flag=best["flags"][i],
            truth=float(theta[i]),
            bounds=(float(bounds[0][i]), float(bounds[1][i])),
        )
        for i, p in enumerate(space.parameters)
    ]
    medians = {k: float(np.median(v)) for k, v in returns.items()}
    first = next(iter(returns))
    headline = [
        f"In the target the EASI policy returns {medians['EASI']:.1f}, the {first} "
        f"policy it started from {medians[first]:.1f}"
        + (f", the Oracle {medians['Oracle']:.1f}" if "Oracle" in medians else "")
        + f" (medians of {len(seeds)} seed{'s' if len(seeds) > 1 else ''})."
    ]
    lost = sum(
        line["non_finite"]
        for line in read_metrics(folder.path / "metrics.jsonl", "search")
    )
    bad = [
        n for n, f in zip(space.names, best["flags"], strict=True) if f != "determined"
    ]
    cases = [(k, model) for k in ("one_step", "open_loop") for model in shares[k]]
    labels = {"one_step": "one step", "open_loop": "0.2 s"}
    error_rows = [
        (channel, *(_share(shares[k][model][channel]) for k, model in cases))
        for channel in errors["channels"]
    ]
    write_report(
        folder.path / "report.html",
        Report(
            title=f"EASI on {pipe.env.name}",
            headline=headline,
            command="python -m train.easi",
            parameters=rows,
            undetermined=[d["meaning"] for d in best["undetermined"]],
            tables=[
                Table(
                    "Return in the target",
                    ("method", "median", *(f"seed {s}" for s in seeds)),
                    [
                        (k, f"{medians[k]:.1f}", *(f"{x:.1f}" for x in v))
                        for k, v in returns.items()
                    ],
                    f"Deterministic policies, {config.eval_episodes} episodes a seed.",
                ),
                Table(
                    "Prediction error on fresh motion of the target",
                    ("channel", *(f"{labels[k]}, {model}" for k, model in cases)),
                    error_rows,
                    "RMS error as a share of the RMS motion, noise-free, pieces at a "
                    "speed limit left out; median over seeds. Never searched on.",
                ),
            ],
            pictures=[
                p for p in _pictures(methods, steps, by_generation, seeds[0]) if p.svg
            ]
            + motion_strip(pipe.env, motion, "EASI", notes),
            diagnostics=[
                Diagnostic(
                    "non-finite simulations",
                    int(lost),
                    ok=lost == 0,
                    note="ranked last, never recombined",
                ),
                Diagnostic(
                    "not determined or at a bound",
                    ", ".join(bad) or "none",
                    ok=not bad,
                    note="these values are not to be believed by themselves"
                    if bad
                    else "",
                ),
            ],
            notes=notes,
            config=folder.config,
            versions=versions(),
        ),
    )
    table = [
        (r.name, f"{r.mean:.4g}", f"{r.std:.2g}", f"{r.truth:.4g}", r.unit, r.flag)
        for r in rows
    ]
    return ("parameter", "mean", "std", "truth", "unit", "flag"), table


def _pictures(methods: str, steps: str, by_generation: str, seed: int) -> list[Any]:
    """The report's figures; one without content has an empty SVG."""
    from easi_jax.io.report.html import Picture

    return [
        Picture(
            "Return by method",
            methods,
            "Final return in the target of each method, a dot for each seed",
        ),
        Picture(
            "Return by training step",
            steps,
            "Return in the target against training steps for each method",
            "As Fig. 5 of the paper: every seed thin, the median bold.",
        ),
        Picture(
            f"Parameters by generation (seed {seed})",
            by_generation,
            "Mean and spread of each parameter over the generations, with the true "
            "value as a dashed line",
            "As Fig. 4 of the paper: the adversarial search alone, before any "
            "refinement; band of two standard deviations.",
        ),
    ]
