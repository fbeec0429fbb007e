"""Files and table of ``train.excite``: commands.csv and excite.json."""

from pathlib import Path
from typing import TYPE_CHECKING

from train._command import say, show_table

if TYPE_CHECKING:
    from easi_jax.excite.candidates import Test
    from easi_jax.excite.play import Bench
    from easi_jax.model.results import ExciteResult
    from train._excite_config import Config


def show(result: "ExciteResult") -> None:
    """Prints what matters of it."""
    from easi_jax.io.report.excite_report import told_lines, told_table

    show_table(*told_table(result))
    for line in told_lines(result):
        say(line)


def write_results(
    config: "Config", bench: "Bench", best: "Test", result: "ExciteResult"
) -> Path:
    """Writes both files; returns the path of the commands."""
    from easi_jax.io.files import atomic_write, to_json
    from easi_jax.io.report.excite_report import commands_csv, excite_json
    from easi_jax.io.runs.folder import RunFolder

    content = excite_json(result)
    text = commands_csv(
        _columns(bench), best.run.time, bench.hold + best.signal, best.run.qpos
    )
    if config.out.suffix == ".csv":
        atomic_write(config.out.with_suffix(".json"), to_json(content))
        atomic_write(config.out, text)
        return config.out
    with RunFolder.open(
        config.out, config, command="train.excite", overwrite=config.overwrite
    ) as folder:
        folder.write_json("excite.json", content)
        return folder.write("commands.csv", text)


def _columns(bench: "Bench") -> list[str]:
    m = bench.models[0]
    way = "ctrl" if bench.feedback is None else "feedforward"
    names = [f"{way}.{m.actuator(a).name}" for a in range(m.nu)]
    for j in range(m.njnt):
        n = {0: 7, 1: 4}.get(int(m.jnt_type[j]), 1)
        ends = [""] if n == 1 else [f".{i}" for i in range(n)]
        names += [f"qpos.{m.joint(j).name}{e}" for e in ends]
    return names
