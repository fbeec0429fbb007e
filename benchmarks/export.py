"""Exported policies beside the policies: largest difference, and time of a call.

    python -m benchmarks.export
    python -m benchmarks.export --runs results/udr results/easi

Every built-in robot with policies of drawn weights, and those of runs that are given.
Differences are those of ``action`` and ``ctrl`` over 10,000 observations, by
onnxruntime and by the program that `jax.export` wrote, against JAX on the same machine.
Written to ``benchmarks/results/export.json``.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any

from benchmarks._common import RESULTS, command_of, write_result
from train._command import main, say, show_table

COUNT = 10_000
GOAL = 1e-5
_CALLS = 2_000  # of one observation, timed


@dataclasses.dataclass(frozen=True)
class Config:
    """Compares exported policies with the policies that they are of."""

    runs: tuple[Path, ...] = ()
    """Finished runs of train.udr, train.easi or train.pipeline, to compare as well."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the drawn policies."""
    folder: Path = RESULTS
    """Where the figures go."""


def run(config: Config) -> None:
    """Exports, compares, writes."""
    from easi_jax.errors import UserError
    from envs import REGISTRY, make

    try:
        import onnxruntime
    except ImportError:
        raise UserError(
            "this needs onnx and onnxruntime: pip install 'easi-jax[export]'"
        ) from None
    cases = []
    for name in REGISTRY:
        env = make(name)
        for seed in config.seeds:
            case = compared(env, drawn_policy(env, seed))
            cases.append({"robot": name, "policy": f"drawn {seed}", **case})
            say(f"{name}, drawn {seed}: {case['onnx']:.1e}")
    for folder in config.runs:
        for case in _of_run(folder):
            cases.append(case)
            say(f"{case['robot']}, {case['policy']}: {case['onnx']:.1e}")
    path = write_result(
        "export",
        command_of("benchmarks.export", config),
        config,
        config.folder,
        onnxruntime=onnxruntime.__version__,
        observations=COUNT,
        cases=cases,
    )
    show_table(
        f"largest difference over {COUNT} observations",
        ("robot", "policy", "ONNX", "StableHLO", "ONNX, us a call"),
        [
            (
                c["robot"],
                c["policy"],
                f"{c['onnx']:.1e}",
                f"{c['stablehlo']:.1e}",
                f"{c['onnx_us']:.0f}",
            )
            for c in cases
        ],
    )
    say(f"written: {path}")


def _of_run(folder: Path) -> list[dict[str, Any]]:
    import jax

    from train._robots import load_policies

    found = load_policies(folder, None, None)
    out = []
    for i, seed in enumerate(found["seeds"]):
        policy = jax.tree.map(lambda x, i=i: x[i], found["policies"])
        name = f"{found['method']}, seed {seed}, trained"
        case = compared(found["env"], policy)
        out.append({"robot": found["env"].name, "policy": name, **case})
    return out


def compared(env: Any, policy: Any) -> dict[str, float]:
    """Largest differences of each export, and microseconds of a call of ONNX."""
    import jax
    import numpy as np

    from easi_jax.export.policy import interface_of, to_onnx, to_stablehlo

    what = policy, interface_of(env), getattr(env, "action_map", None)
    obs = observations(env, policy)
    want = by_jax(env, policy, obs)
    session = onnx_session(to_onnx(*what))
    program, _ = to_stablehlo(*what)
    exported = jax.export.deserialize(bytearray(program)).call(obs)
    one = {"observation": obs[:1]}
    begin = time.perf_counter()
    for _ in range(_CALLS):
        session.run(None, one)
    seconds = time.perf_counter() - begin

    def difference(got: Any) -> float:
        return max(
            float(np.abs(np.asarray(got[key]) - value).max())
            for key, value in want.items()
        )

    return {
        "onnx": difference(by_onnx(session, obs)),
        "stablehlo": difference(exported),
        "onnx_us": 1e6 * seconds / _CALLS,
    }


def drawn_policy(env: Any, seed: int = 0, hidden: tuple[int, ...] = (256, 256)) -> Any:
    """A policy of drawn weights whose normalizer is drawn, too."""
    import jax
    import jax.numpy as jnp

    from easi_jax.rl.networks import PolicyParams, make_networks

    networks = make_networks(env.obs_size, env.action_size, hidden)
    k_net, k_mean, k_std = jax.random.split(jax.random.key(seed), 3)
    return PolicyParams(
        mean=jax.random.normal(k_mean, (env.obs_size,)),
        std=jnp.exp(jax.random.normal(k_std, (env.obs_size,))),
        network=networks.policy_network.init(k_net),
    )


def observations(env: Any, policy: Any) -> Any:
    """As a trained policy sees them, and some far beyond, ``(COUNT, obs_size)``."""
    import numpy as np

    rng = np.random.default_rng(1)
    size = np.exp(rng.normal(0.0, 0.5, (COUNT, 1)))
    z = size * rng.normal(size=(COUNT, env.obs_size))
    return np.asarray(policy.mean + policy.std * z, np.float32)


def onnx_session(content: bytes) -> Any:
    """onnxruntime with an exported policy, on the CPU."""
    import onnxruntime

    return onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])


def by_onnx(session: Any, obs: Any) -> dict[str, Any]:
    """Outputs of an exported policy by name."""
    import numpy as np

    names = [o.name for o in session.get_outputs()]
    values = session.run(names, {"observation": obs})
    return {n: np.asarray(v) for n, v in zip(names, values, strict=True)}


def by_jax(env: Any, policy: Any, obs: Any) -> dict[str, Any]:
    """What the policy itself gives: ``action``, and ``ctrl`` where the robot says how
    that follows."""
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.rl.networks import act

    action = act(policy, jnp.asarray(obs), deterministic=True)
    out = {"action": np.asarray(action)}
    if getattr(env, "action_map", None) is not None:
        out["ctrl"] = np.asarray(env.action_map(jnp.asarray(obs), action))
    return out


if __name__ == "__main__":
    main(Config, run, name="benchmarks.export")
