"""How often train.gap is right, counted over the cases of ``benchmarks.gap``."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import hypot, sqrt
from typing import Any

GOALS = {
    "right name and place first": (0.97, "at least"),
    "the same, or listed as alike": (0.97, "at least"),
    "false alarms without effect": (0.02, "at most"),
    "wrong with confidence above 0.8": (0.02, "at most"),
    "pairs both found": (0.90, "at least"),
    "three to five, all found": (0.75, "at least"),
    "verdict right": (0.95, "at least"),
}
PARAMETER_GOAL = 0.05  # median relative error
RATIO_GOAL = 1.2  # median gap after, in floors
_VECTORS = (("x", "y", "z"), ("roll", "pitch"))
_SURE = 0.8
_BINS = 5


def keys_of(effects: Iterable[Mapping[str, Any]]) -> list[str]:
    """``EFFECT@PLACE`` of each effect of a ``gap.json`` or an answer."""
    return [f"{e['effect']}@{e['at']}" for e in effects]


def wilson(hits: int, count: int, z: float = 1.96) -> tuple[float, float]:
    """95 % interval of a share (E. B. Wilson, *J. Am. Stat. Assoc.* 22, 1927)."""
    if not count:
        return 0.0, 1.0
    p = hits / count
    middle = (p + z * z / (2 * count)) / (1 + z * z / count)
    half = z * sqrt(p * (1 - p) / count + z * z / (4 * count**2)) / (1 + z * z / count)
    return max(0.0, middle - half), min(1.0, middle + half)


def shares(rows: Sequence[dict[str, Any]]) -> dict[str, tuple[int, int]]:
    """Hits and counts of what is asked, by its name in `GOALS`."""
    kinds = {
        k: [r for r in rows if r["kind"] == k] for k in ("single", "pair", "several")
    }
    without = [r for r in rows if r["kind"] in ("none", "wrong_own")]

    def count(part: Sequence[dict[str, Any]], hit: Any) -> tuple[int, int]:
        return sum(bool(hit(r)) for r in part), len(part)

    def rash(r: dict[str, Any]) -> bool:
        return any(not ok and c > _SURE for ok, c in judged([r]))

    return {
        "right name and place first": count(kinds["single"], lambda r: r["right"]),
        "the same, or listed as alike": count(kinds["single"], told),
        "false alarms without effect": count(without, lambda r: r["named"]),
        "wrong with confidence above 0.8": count(rows, rash),
        "pairs both found": count(kinds["pair"], lambda r: r["right"]),
        "three to five, all found": count(kinds["several"], lambda r: r["right"]),
        "verdict right": count(rows, has_right_verdict),
    }


def has_right_verdict(row: Mapping[str, Any]) -> bool:
    """Whether a verdict is that of the case: velocities that are rightly named late are
    an effect, which explains what nothing else is missing in."""
    late = bool(row["readings"]) and not row["truth"]
    return row["verdict"] in row["verdicts"] or (
        late and row["verdict"] == "explained" and "no_gap" in row["verdicts"]
    )


def told(row: Mapping[str, Any]) -> bool:
    """Whether each effect of a case was named first, or is listed as one that the
    held-out data do not tell from what was."""
    return all(row["found"][k] or row["listed"][k] for k in row["truth"])


def judged(rows: Sequence[dict[str, Any]]) -> list[tuple[bool, float]]:
    """For every effect named: whether it is there, and the confidence stated."""
    return [
        pair for r in rows for pair in zip(r["there"], r["confidence"], strict=True)
    ]


def brier(pairs: Sequence[tuple[bool, float]]) -> float:
    """Mean squared distance of confidence from what was the case."""
    return sum((c - ok) ** 2 for ok, c in pairs) / max(len(pairs), 1)


def calibration(pairs: Sequence[tuple[bool, float]]) -> list[tuple[float, float, int]]:
    """Mean confidence, share that was right, and count, by bins of confidence."""
    out = []
    for k in range(_BINS):
        inside = [(ok, c) for ok, c in pairs if min(int(c * _BINS), _BINS - 1) == k]
        n = len(inside)
        if n:
            mean = sum(c for _, c in inside) / n
            out.append((mean, sum(ok for ok, _ in inside) / n, n))
    return out


def parameter_errors(rows: Sequence[dict[str, Any]]) -> list[float]:
    """Relative errors of the parameters of effects that were named right, one each.

    The parts of a vector (x, y, z; roll, pitch) are one parameter. Left out is where a
    ripple stands in its period and what a deadband does beyond its edge, which have no
    size.
    """
    out = []
    for r, at, truth in _named_right(rows):
        told = r["parameters"][at]
        for group in _grouped(truth):
            size = hypot(*(truth[k] for k in group))
            if size > 0 and all(k in told for k in group):
                out.append(hypot(*(told[k] - truth[k] for k in group)) / size)
    return out


def standardised(rows: Sequence[dict[str, Any]]) -> list[float]:
    """Errors of the parameters of effects that were named right, in units of the
    standard deviations that were stated; as `parameter_errors`, but each number by
    itself."""
    out = []
    for r, at, truth in _named_right([r for r in rows if "deviations" in r]):
        told, std = r["parameters"][at], r["deviations"][at]
        for k in (k for group in _grouped(truth) for k in group):
            if k in told and std[k] > 0:
                out.append((told[k] - truth[k]) / std[k])
    return out


def _named_right(
    rows: Sequence[dict[str, Any]],
) -> Iterator[tuple[dict[str, Any], int, dict[str, Any]]]:
    """Cases, the place of a true effect among their names, and its parameters."""
    for r in rows:
        for name, truth in zip(r["truth"], r["true_parameters"], strict=True):
            if name in r["named"]:
                yield r, r["named"].index(name), truth


def _grouped(parameters: Mapping[str, Any]) -> list[list[str]]:
    vectors = [[k for k in v if k in parameters] for v in _VECTORS]
    inside = {k for v in _VECTORS for k in v}
    unsized = {"phase"} | {k for k, v in parameters.items() if isinstance(v, str)}
    single = [[k] for k in parameters if k not in inside | unsized]
    return [g for g in (*vectors, *single) if g]


def ratios(rows: Sequence[dict[str, Any]]) -> list[float]:
    """Gap after over floor, of cases with one effect."""
    return [
        r["gap"]["after"] / r["gap"]["floor"] for r in rows if r["kind"] == "single"
    ]


def confusion(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """First name by true effect, of cases with one."""
    out: dict[str, dict[str, int]] = {}
    for r in rows:
        if r["kind"] != "single":
            continue
        truth = r["truth"][0].split("@")[0]
        first = "right twin" if r["right"] else "none"
        if r["named"] and not r["right"]:
            first = r["named"][0].split("@")[0]
        elif r["named"] and r["named"][0] in r["truth"]:
            first = truth
        row = out.setdefault(truth, {})
        row[first] = row.get(first, 0) + 1
    return out


def is_among(expected: str, names: set[str]) -> bool:
    """Whether one of ``A|B`` is among names ``EFFECT@PLACE``, at its place if given."""
    options = expected.split("|")
    return any(n in options or n.split("@")[0] in options for n in names)
