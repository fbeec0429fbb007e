"""A stage that was stopped keeps what it had told, and tells the rest once."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from easi_jax.errors import UserError
from easi_jax.io.runs.folder import RunFolder
from easi_jax.io.runs.metrics import read_metrics
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


def test_a_result_that_is_no_number_is_named() -> None:
    def found(mean: float, factor: float) -> SimpleNamespace:
        means, factors = np.zeros((2, 2)), np.stack([np.eye(2)] * 2)
        means[1, 0], factors[1, 1, 0] = mean, factor
        return SimpleNamespace(mean=jnp.array(means), factor=jnp.array(factors))

    found_check((3, 7), ("mass", "kp"), found(0.5, 0.1))
    for odd, name in ((found(np.nan, 0.1), "mass"), (found(0.5, np.inf), "kp")):
        with pytest.raises(UserError, match=f"seed 7: .* not finite for {name};"):
            found_check((3, 7), ("mass", "kp"), odd)
