"""An experiment's cells as jobs, by submitit: on Slurm, or on this machine.

    python -m scripts.sweep table5 --engine local --jobs 2 --gpus 0
    python -m scripts.sweep table1 --robot ant --jobs 16 --partition gpu

Needs the extra ``sweeps``. A job runs a share of the cells (``benchmarks.paper
--shard``) and skips those that are done; Slurm requeues one whose time ran out.
"""

import dataclasses
from pathlib import Path
from typing import Any, Literal

import tyro

from benchmarks import paper
from train._command import main, say


@dataclasses.dataclass(frozen=True)
class Config:
    """Submits the cells of one of the paper's tables or figures as jobs."""

    cells: tyro.conf.OmitArgPrefixes[paper.Config]
    """What is run: as for benchmarks.paper."""
    jobs: int = 4
    """Jobs that share the cells."""
    engine: Literal["slurm", "local"] = "slurm"
    """Slurm, or processes of this machine."""
    gpus: int = 1
    """GPUs of a job."""
    cpus: int = 8
    """CPU cores of a job (slurm)."""
    memory: int = 32
    """Memory of a job (slurm) [GB]."""
    hours: float = 12.0
    """Longest time of a job; it is requeued up to three times."""
    partition: str | None = None
    """Slurm's partition."""
    logs: Path = Path("results/sweep")
    """Where jobs write what they print."""
    wait: bool = True
    """Wait for the jobs, and say which failed."""


class Part:
    """What a job does; submitit sends it there and calls it."""

    def __init__(self, config: paper.Config) -> None:
        self.config = config

    def __call__(self) -> None:
        """Runs its cells."""
        paper.run(self.config)

    def checkpoint(self) -> Any:
        """Its time ran out: the same again, less the cells that are done."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


def run(config: Config) -> None:
    """Submits and, where asked, waits."""
    from easi_jax.errors import UserError

    for name in ("jobs", "gpus", "hours"):
        value = getattr(config, name)
        if value <= 0 and not (name == "gpus" and value == 0):
            raise UserError(f"--{name} is {value}: give a positive number")
    cells = paper.cells(config.cells)  # mistakes show here, not in every job
    if config.cells.list or config.cells.only or config.cells.shard != "1/1":
        raise UserError("--list, --only and --shard are for benchmarks.paper itself")
    jobs = _submit(config, min(config.jobs, len(cells)))
    for i, job in enumerate(jobs, 1):
        say(f"job {job.job_id}: part {i}/{len(jobs)}, log {job.paths.stdout}")
    if not config.wait:
        return
    failed = []
    for i, job in enumerate(jobs, 1):
        if job.exception() is not None:
            failed.append(i)
            said = (job.stderr() or job.state).strip().splitlines()[-1]
            say(f"part {i} failed: {said} (see {job.paths.stderr})")
    if failed:
        raise UserError(
            f"{len(failed)} of {len(jobs)} jobs failed; the same command runs what is "
            "not done yet"
        )
    say(f"{len(cells)} cells are done: {config.cells.out}")


def _submit(config: Config, parts: int) -> list[Any]:
    from easi_jax.errors import UserError

    try:
        import submitit
    except ImportError as error:
        raise UserError(
            "submitit is missing: pip install -c constraints.txt -e '.[sweeps]'"
        ) from error
    shares = [
        Part(dataclasses.replace(config.cells, shard=f"{i + 1}/{parts}"))
        for i in range(parts)
    ]
    if config.engine == "local":
        jobs = []
        for i, share in enumerate(shares):
            local = submitit.LocalExecutor(folder=config.logs)
            own = range(i * config.gpus, (i + 1) * config.gpus)
            local.update_parameters(
                timeout_min=round(config.hours * 60),
                gpus_per_node=config.gpus,
                visible_gpus=tuple(own),
            )
            jobs.append(local.submit(share))
        return jobs
    try:
        slurm = submitit.SlurmExecutor(folder=config.logs, max_num_timeout=3)
    except RuntimeError as error:
        raise UserError(f"{error}; --engine local runs on this machine") from error
    options = {"partition": config.partition} if config.partition else {}
    slurm.update_parameters(
        job_name="easi-sweep",
        time=round(config.hours * 60),
        gpus_per_node=config.gpus,
        cpus_per_task=config.cpus,
        mem=f"{config.memory}G",
        array_parallelism=parts,
        **options,
    )
    with slurm.batch():  # one job array
        return [slurm.submit(share) for share in shares]


if __name__ == "__main__":
    main(Config, run, name="scripts.sweep")
