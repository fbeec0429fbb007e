"""Writes cases: python -m tests.gap_cases --kind single --seeds 0 1 2 --out DIR."""

import argparse
import time
from pathlib import Path

from tests.gap_cases.draw import CASE_KINDS, draw_case
from tests.gap_cases.effects import KINDS, OUTSIDE, CaseError
from tests.gap_cases.robots import MECHANISMS


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.gap_cases")
    parser.add_argument("--kind", choices=CASE_KINDS, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--cheap", action="store_true", help="one or two joints only")
    parser.add_argument("--effect", choices=(*KINDS, *OUTSIDE), default="")
    parser.add_argument("--mechanism", choices=MECHANISMS, default="")
    arguments = parser.parse_args()
    for seed in arguments.seeds:
        begun = time.perf_counter()
        directory = arguments.out / f"{arguments.kind}_{seed}"
        try:
            case = draw_case(
                seed,
                arguments.kind,
                directory,
                cheap=arguments.cheap,
                effect=arguments.effect,
                mechanism=arguments.mechanism,
            )
        except CaseError as error:
            print(f"{directory.name}: {error}")
            continue
        what = " + ".join(f"{e.name}@{e.at}" for e in case.effects) or arguments.kind
        print(
            f"{directory.name}: {case.mechanism.name}, {what}, gap {case.gap.gap:.4g}, "
            f"{case.gap.ratio:.2f} floors, {time.perf_counter() - begun:.1f} s"
        )


if __name__ == "__main__":
    main()
