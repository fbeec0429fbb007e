"""Hostile and broken files for every reader of the project.

    python -m benchmarks.fuzz --cases 10000 --seed 0

Logs, mapping, parameter and effects files, files of runs, checkpoints, models and names
in reports: good files with bytes, numbers, words, lines and columns changed, files that
hypothesis draws, pickles, YAML tags and alias bombs, links, pipes and folders in place
of files, models that name files elsewhere. A reader may accept a file or refuse it with
a `UserError`. All else is a failure: another exception, a process that ends, more than
--limit seconds, something unpickled or started, a file written outside of the folder.

About five minutes; results go to ``benchmarks/results/fuzz.json``.
"""

import dataclasses
import multiprocessing
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

from train._command import main, say, show_table

_START = 300.0  # s, that a process may take to be ready
_SHOWN = 20


@dataclasses.dataclass(frozen=True)
class Config:
    """Feeds hostile and broken files to every reader."""

    cases: int = 10_000
    """Cases in all."""
    seed: int = 0
    """Of the cases; the same seed gives the same."""
    limit: float = 60.0
    """Seconds that a case may take."""
    readers: tuple[str, ...] = ()
    """Only readers whose name holds one of these; results are then not written."""


def run(config: Config) -> None:
    """Runs, shows, writes."""
    from benchmarks._common import command_of, write_result
    from benchmarks.fuzz_readers import READERS
    from easi_jax.errors import UserError

    chosen = [
        r
        for r in READERS
        if not config.readers or any(word in r.name for word in config.readers)
    ]
    if not chosen:
        raise UserError(f"--readers: {', '.join(r.name for r in READERS)}")
    jobs = [(r.name, max(1, round(config.cases * r.share))) for r in chosen]
    found = fuzz(jobs, config.seed, config.limit)
    for r in found:
        for text in r["failures"]:
            say(f"{r['reader']}: {text}")
    columns = ("cases", "refused", "accepted", "failed", "seconds", "slowest_s")
    show_table(
        "Hostile and broken files",
        ("reader", *columns),
        [(r["reader"], *(r[c] for c in columns)) for r in found],
    )
    if config.readers:
        return
    total = {c: sum(r[c] for r in found) for c in columns[:4]}
    path = write_result(
        "fuzz",
        command_of("benchmarks.fuzz", config),
        config,
        total=total,
        seconds=round(sum(r["seconds"] for r in found), 1),  # of the processor
        readers=found,
    )
    say(f"{total['cases']} cases, {total['failed']} failed; written: {path}")


def fuzz(
    jobs: Sequence[tuple[str, int]], seed: int, limit: float
) -> list[dict[str, Any]]:
    """Counts of readers, each with a number of cases: ``cases``, ``refused``,
    ``accepted``, ``failed``, ``kinds``, ``seconds`` of the processor, ``slowest_s``,
    and the first ``failures``."""
    found = {name: _Counts() for name, _ in jobs}
    with tempfile.TemporaryDirectory() as place:
        left: list[tuple[str, int, int]] = [(name, count, 0) for name, count in jobs]
        while left:
            at = (left[0][0], left[0][2])  # where a process that hangs or ends was
            for told in _process(left, seed, limit, place):
                if isinstance(told, str):
                    found[at[0]].add(at[1], "?", "failed", told, 0.0)
                    break
                name, i, *rest = told
                if i is None:  # or hypothesis had no more to draw
                    left = left[1:]
                    at = (left[0][0], 0) if left else at
                else:
                    found[name].add(i, *rest)
                    at = (name, i + 1)
            if left:
                left[0] = (left[0][0], left[0][1], at[1] + 1)
    return [c.result(name) for name, c in found.items()]


class _Counts:
    def __init__(self) -> None:
        self.outcomes, self.kinds = Counter[str](), Counter[str]()
        self.seconds, self.slowest = 0.0, 0.0
        self.failures: list[str] = []

    def add(self, i: int, kind: str, outcome: str, text: str, seconds: float) -> None:
        self.outcomes[outcome] += 1
        self.kinds[kind] += 1
        self.seconds += seconds
        self.slowest = max(self.slowest, seconds)
        if text:
            self.failures.append(f"case {i} ({kind}): {text}")

    def result(self, name: str) -> dict[str, Any]:
        return {
            "reader": name,
            "cases": self.outcomes.total(),
            **{o: self.outcomes[o] for o in ("refused", "accepted", "failed")},
            "kinds": dict(sorted(self.kinds.items())),
            "seconds": round(self.seconds, 2),
            "slowest_s": round(self.slowest, 3),
            "failures": self.failures[:_SHOWN],
        }


def _process(
    jobs: Sequence[tuple[str, int, int]], seed: int, limit: float, place: str
) -> Iterator[Any]:
    """What a process tells of its cases, and why it ended before its last if it did."""
    from benchmarks.fuzz_worker import work

    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe(duplex=False)
    folder = tempfile.mkdtemp(dir=place)
    process = context.Process(
        target=work, args=(there, list(jobs), seed, folder), daemon=True
    )
    process.start()
    there.close()
    patience = _START
    try:
        while True:
            if not here.poll(patience):
                yield f"more than {patience:g} s"
                return
            told = here.recv()
            if told is None:
                return
            yield told
            # The next reader imports and makes its good files first.
            patience = _START if told[1] is None else limit
    except EOFError:
        process.join()
        if process.exitcode == 1:
            raise RuntimeError("the fuzzer itself failed; see above") from None
        yield f"the process ended ({process.exitcode})"
    finally:
        process.kill()
        process.join()
        here.close()


if __name__ == "__main__":
    main(Config, run, name="benchmarks.fuzz")
