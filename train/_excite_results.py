"""Files and table of ``train.excite``: commands.csv and excite.json."""

import csv
import io
from pathlib import Path
from typing import Any

from train._command import say, show_table

_WORST = 10  # effects in the printed table
_PAIRS = 20  # in the file


def results(config: Any, problem: Any, tests: Any, choice: Any) -> dict[str, Any]:
    """The content of ``excite.json``."""
    best = tests[choice.best]
    order = sorted(range(len(tests)), key=lambda i: -choice.scores[i])
    open_loop = problem.bench.feedback is None
    return {
        "schema": 1,
        "model": problem.name,
        "signal": {
            "what": best.recipe.text(),
            "kind": best.recipe.kind,
            "band": [best.recipe.low, best.recipe.high],
            "level": best.recipe.level,
            "amplitude": _named(problem, "actuator", best.amplitude),
            "hold": _named(problem, "actuator", problem.bench.hold),
            "start": _start(problem),
            "seed": best.seed,
            "duration": config.duration,
            "rate": 1.0 / problem.bench.dt,
        },
        "play": "open-loop" if open_loop else "feed-forward",
        "controller": None if open_loop else _controller(problem),
        "limits": _limits(config, problem, best),
        "score": float(choice.scores[choice.best]),
        "noise": _named(problem, "dof", problem.noise),
        "horizon": config.horizon,
        "effects": _effects(choice),
        "worst_pairs": _pairs(choice),
        "told_apart": _wanted(problem, choice),
        "no_trace": [
            k for k, u in zip(_keys(choice), choice.known.unseen, strict=True) if u
        ],
        "twins": _twins(choice),
        "tried": [
            {
                "what": tests[i].recipe.text(),
                "amplitude": _named(problem, "actuator", tests[i].amplitude),
                "score": float(choice.scores[i]),
            }
            for i in order
        ],
        "simulated": {
            "windows_of_each_test": choice.windows,
            "changes_of_the_model": choice.vectors,
            "wrong_models": "mass and friction 0.8 and 1.2 times the model's",
        },
        "notes": problem.notes,
    }


def _keys(choice: Any) -> tuple[str, ...]:
    return choice.found[choice.best].keys


def _named(problem: Any, kind: str, values: Any) -> dict[str, float]:
    from easi_jax.model.joint_space import joint_name, scalar_dofs

    m = problem.mj_model
    if kind == "actuator":
        return {m.actuator(a).name: float(values[a]) for a in range(m.nu)}
    return {joint_name(m, j): float(values[d]) for j, (_, d) in scalar_dofs(m).items()}


def _start(problem: Any) -> dict[str, float]:
    from easi_jax.model.joint_space import joint_name, scalar_dofs

    m, start = problem.mj_model, problem.bench.start
    return {joint_name(m, j): float(start[q]) for j, (q, _) in scalar_dofs(m).items()}


def _controller(problem: Any) -> dict[str, Any]:
    f = problem.bench.feedback
    return {
        "assumed": "ctrl = feedforward - kp (qpos - start) - kd qvel, at the rate",
        "kp": _named(problem, "actuator", f.kp),
        "kd": _named(problem, "actuator", f.kd),
    }


def _limits(config: Any, problem: Any, best: Any) -> dict[str, Any]:
    """What was allowed, and what the model and the wrong ones reach."""
    import numpy as np

    from easi_jax.model.joint_space import joint_name, scalar_dofs

    m, lim = problem.mj_model, problem.bench.limits
    q_all = np.concatenate([x.qpos for x in best.motions])
    v_all = np.concatenate([x.qvel for x in best.motions])
    u_all = np.concatenate([x.ctrl for x in best.motions])
    f_all = np.concatenate([x.force for x in best.motions])
    joints = {}
    for j, (q, d) in scalar_dofs(m).items():
        joints[joint_name(m, j)] = {
            "allowed": [lim.low[d], lim.high[d]],
            "reached": [q_all[:, q].min(), q_all[:, q].max()],
            "model_reaches": [
                best.run.qpos[:, q].min(),
                best.run.qpos[:, q].max(),
            ],
            "range": list(m.jnt_range[j]) if m.jnt_limited[j] else None,
            "speed_allowed": lim.speed[d],
            "speed_reached": np.abs(v_all[:, d]).max(),
        }
    actuators = {
        m.actuator(a).name: {
            "ctrl_allowed": [lim.ctrl_low[a], lim.ctrl_high[a]],
            "ctrl_reached": [u_all[:, a].min(), u_all[:, a].max()],
            "force_allowed": lim.force[a],
            "force_reached": np.abs(f_all[:, a]).max(),
        }
        for a in range(m.nu)
    }
    return {"margin": config.margin, "joints": joints, "actuators": actuators}


def _effects(choice: Any) -> dict[str, Any]:
    from easi_jax.excite.separation import nearest_rival

    best, known = choice.found[choice.best], choice.known
    distance, rival = nearest_rival(best, known)
    out = {}
    for i, key in enumerate(best.keys):
        out[key] = {
            "visible": float(best.visible[i]),
            "nearest": best.keys[rival[i]] if rival[i] >= 0 else None,
            "apart": float(distance[i]),
            "numbers": [
                {
                    "name": name,
                    "unit": unit,
                    "size": size,
                    "std": std,
                    "std_per_size": std / size,
                }
                for (name, unit, size), std in zip(
                    choice.numbers[key], best.std[key], strict=True
                )
            ],
        }
    return out


def _pairs(choice: Any) -> list[dict[str, Any]]:
    """The pairs that the chosen test tells apart worst, twins left out."""
    s, known = choice.found[choice.best], choice.known
    rows = []
    for i in range(len(s.keys)):
        for j in range(len(s.keys)):
            if i != j and not known.unseen[i] and not known.same[i, j]:
                rows.append((float(s.apart[i, j]), s.keys[i], s.keys[j]))
    return [
        {"effect": a, "as": b, "apart": d, "of_visible": d / _visible(s, a)}
        for d, a, b in sorted(rows)[:_PAIRS]
    ]


def _visible(s: Any, key: str) -> float:
    return max(float(s.visible[s.keys.index(key)]), 1e-12)


def _wanted(problem: Any, choice: Any) -> list[dict[str, Any]]:
    s = choice.found[choice.best]
    return [
        {
            "effect": s.keys[i],
            "as": s.keys[j],
            "apart": float(s.apart[i, j]),
            "best_of_all": float(max(f.apart[i, j] for f in choice.found)),
            "no_test_can": bool(choice.known.same[i, j] or choice.known.unseen[i]),
        }
        for i, j in choice.wanted
    ]


def _twins(choice: Any) -> list[dict[str, str]]:
    keys, same = _keys(choice), choice.known.same
    out = []
    for i, a in enumerate(keys):
        for j, b in enumerate(keys):
            if same[i, j] and (i < j or not same[j, i]):
                kind = "twins" if same[j, i] else "a case of"
                out.append({"effect": a, "is": kind, "as": b})
    return out


def show(content: dict[str, Any]) -> None:
    """Prints what matters of it."""
    signal, effects = content["signal"], content["effects"]
    gone = set(content["no_trace"])
    rows = [
        (
            key,
            ", ".join(
                f"{n['size']:.2g} {n['unit']}".removesuffix(" 1")
                for n in e["numbers"][:1]
            ),
            ", ".join(_plus_minus(n) for n in e["numbers"][:1]),
            f"{e['visible']:.1f}",
            f"{e['apart']:.1f}",
            e["nearest"] or "nothing",
        )
        for key, e in sorted(effects.items(), key=lambda x: x[1]["apart"])
        if key not in gone
    ]
    wanted = content["told_apart"]
    if wanted:
        show_table(
            "What was to be told apart, in times the noise",
            ["effect", "as", "this test", "best of all tests"],
            [
                (
                    w["effect"],
                    w["as"],
                    f"{w['apart']:.1f}",
                    "none can" if w["no_test_can"] else f"{w['best_of_all']:.1f}",
                )
                for w in wanted
            ],
        )
    else:
        show_table(
            f"The {min(_WORST, len(rows))} of {len(rows)} effects told worst: "
            "distances in times the noise, of an effect of this size",
            ["effect", "size", "known to", "from nothing", "from a rival", "rival"],
            rows[:_WORST],
        )
    for twin in content["twins"]:
        if twin["is"] == "twins":
            say(
                f"twins in this model, which no test tells apart: {twin['effect']} "
                f"and {twin['as']}"
            )
    if gone:
        say(f"no trace in any test: {', '.join(content['no_trace'])}")
    scores = [t["score"] for t in content["tried"]]
    say(
        f"chosen of {len(scores)} tests: {signal['what']}, "
        + ", ".join(f"{v:.3g} at {k}" for k, v in signal["amplitude"].items())
        + f"; score {scores[0]:.3g}, median {scores[len(scores) // 2]:.3g}, worst "
        f"{scores[-1]:.3g}"
    )
    for name, j in content["limits"]["joints"].items():
        low, high = j["reached"]
        a, b = (float(x) for x in j["allowed"])
        allowed = f"{a:.3g} to {b:.3g}" if abs(a) < 1e300 else "any"
        say(
            f"{name}: {low:.3g} to {high:.3g} in the model and the wrong ones "
            f"(allowed {allowed}), speed up to {j['speed_reached']:.3g}"
        )
    if content["play"] == "feed-forward":
        say(
            "play as feed-forward: constant commands do not hold this machine, so add "
            "the columns feedforward.* to your own position controller about the start "
            "pose, and log what is sent in all; excite.json names the controller that "
            "was assumed"
        )


def _plus_minus(number: dict[str, Any]) -> str:
    std = float(number["std"])
    if std > 1e300:
        return "nothing"
    return f"± {std:.2g} {number['unit']}".removesuffix(" 1")


def write_results(
    config: Any, problem: Any, best: Any, content: dict[str, Any]
) -> Path:
    """Writes both files; returns the path of the commands."""
    from easi_jax.io.files import atomic_write, to_json
    from easi_jax.io.runs.folder import RunFolder

    text = commands_csv(problem, best)
    if config.out.suffix == ".csv":
        atomic_write(config.out.with_suffix(".json"), to_json(content))
        atomic_write(config.out, text)
        return config.out
    with RunFolder.open(
        config.out, config, command="train.excite", overwrite=config.overwrite
    ) as folder:
        folder.write_json("excite.json", content)
        return folder.write("commands.csv", text)


def commands_csv(problem: Any, best: Any) -> str:
    """The commands, with the positions that the model predicts, as a log."""
    from easi_jax.model.joint_space import position_names

    m, bench = problem.mj_model, problem.bench
    way = "ctrl" if bench.feedback is None else "feedforward"
    names = ["time", *(f"{way}.{m.actuator(a).name}" for a in range(m.nu))]
    names += [f"qpos.{name}" for name in position_names(m)]
    out = io.StringIO()
    write = csv.writer(out, lineterminator="\n").writerow
    write(names)
    sent = bench.hold + best.signal
    for t, u, q in zip(best.run.time, sent, best.run.qpos, strict=True):
        write([f"{t:.6f}", *(f"{x:.9g}" for x in u), *(f"{x:.9g}" for x in q)])
    return out.getvalue()
