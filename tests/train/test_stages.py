"""A stage that was stopped keeps what it had told, and tells the rest once."""

import dataclasses
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.errors import UserError
from easi_jax.estimation.posterior import Estimate
from easi_jax.io.runs.folder import RunFolder
from easi_jax.io.runs.metrics import read_metrics
from easi_jax.model.distribution import Distribution
from train._stages import found_check, run_stage


@pytest.mark.parametrize("per_step", [1, 100])
@pytest.mark.parametrize("at", ["check", "rows told, no checkpoint"])
def test_metrics_of_a_stage_that_goes_on(
    tmp_path: Path, per_step: int, at: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stage(resume: bool, stop: bool) -> None:
        def check(first: int, _: Any) -> None:
            if stop and at == "check" and first == 4:
                raise KeyboardInterrupt

        def advance(x: Any, n: int) -> tuple[Any, Any]:
            return x + n, x + jnp.arange(1, n + 1)

        def rows(first: int, info: Any) -> Any:
            return [(int(k) * per_step, {"value": float(k)}) for k in info]

        with RunFolder.open(tmp_path / "run", {}, resume=resume) as run:
            run_stage(
                *(run, "train", 6, 2, lambda: jnp.zeros((), int), advance, rows),
                check=check,
                per_step=per_step,
            )

    from easi_jax.io.runs import checkpoints

    save = checkpoints.save

    def lost(folder: Path, step: int, *more: Any, **named: Any) -> Any:
        if step == 6 and at != "check":
            raise KeyboardInterrupt
        return save(folder, step, *more, **named)

    with monkeypatch.context() as patched:
        patched.setattr(checkpoints, "save", lost)
        with pytest.raises(KeyboardInterrupt):
            stage(resume=False, stop=True)
    stage(resume=True, stop=False)
    told = read_metrics(tmp_path / "run" / "metrics.jsonl", "train")
    assert [row["step"] for row in told] == [k * per_step for k in range(1, 7)]


@pytest.mark.fault("simulations that explode, parameters at absurd corners")
def test_a_fit_that_diverged_is_no_result() -> None:
    """The second of two seeds: its mean, its spread, or every cost."""

    def found(**changed: np.ndarray) -> Estimate:
        none: dict[str, Any] = {
            f.name: jnp.zeros((2, 0)) for f in dataclasses.fields(Estimate)
        }
        given = {"mean": np.zeros((2, 2)), "factor": np.stack([np.eye(2)] * 2)}
        given |= {"cost": np.ones((2, 3)), "hessian": np.stack([np.eye(2)] * 2)}
        for key, value in changed.items():
            given[key][1] = value
        a = {key: jnp.array(value) for key, value in given.items()}
        none_of = dict.fromkeys(("low", "high", "uniform"), jnp.zeros((2, 0)))
        told = Distribution(mean=a.pop("mean"), factor=a.pop("factor"), **none_of)
        none |= {**a, "distribution": told, "doubted": ()}
        return Estimate(**none)

    found_check((3, 7), ("mass", "kp"), found())
    for odd, why in (
        (
            {"mean": np.array([np.nan, 0.0])},
            "mean or its spread is not finite for mass",
        ),
        ({"factor": np.diag([1.0, np.inf])}, "mean or its spread is not finite for kp"),
        ({"cost": np.full(3, np.nan)}, "no simulation of the measured pieces stays"),
        ({"hessian": np.full((2, 2), np.inf)}, "what the data say of the parameters"),
    ):
        with pytest.raises(UserError, match=f"seed 7: the fit diverged: .*{why}"):
            found_check((3, 7), ("mass", "kp"), found(**odd))
