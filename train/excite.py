"""``python -m train.excite``: which commands would show what the model lacks?"""

from typing import TYPE_CHECKING

from train._command import main, say
from train._excite_config import Config

if TYPE_CHECKING:
    from easi_jax.excite.candidates import Test
    from train._excite_problem import ExciteProblem


def run(config: Config) -> None:
    """Reads and checks, simulates, chooses, writes."""
    from train._excite_problem import read_excite_problem
    from train._excite_results import show, write_results
    from train._robots import check_seeds

    check_seeds((config.seed,))
    problem = read_excite_problem(config)
    for note in problem.notes:
        say(f"note: {note}")
    tests = _tests(config, problem)
    from easi_jax.excite.choose import choose
    from easi_jax.excite.result import excite_result

    choice = choose(
        problem.mj_model,
        problem.space,
        tests,
        problem.noise,
        config.horizon,
        config.only,
        problem.pairs,
        problem.strengths,
        problem.scales,
        tell=say,
    )
    result = excite_result(
        problem.bench,
        tests,
        choice,
        model=problem.name,
        noise=problem.noise,
        horizon=config.horizon,
        margin=config.margin,
        duration=config.duration,
        notes=problem.notes,
    )
    show(result)
    written = write_results(config, problem.bench, tests[choice.best], result)
    say(f"commands: {written}")


def _tests(config: Config, problem: "ExciteProblem") -> "list[Test]":
    from easi_jax.errors import UserError
    from easi_jax.excite.candidates import make_tests, recipes

    chosen = recipes(1.0 / problem.bench.dt, config.duration)
    say(f"fitting {len(chosen)} tests of {config.duration:g} s into the limits ...")
    left = []
    tests = make_tests(
        problem.bench,
        chosen,
        problem.most,
        config.duration,
        config.seed,
        lambda recipe, test: left.append(recipe.text()) if test is None else None,
    )
    if left:
        say(f"note: not to be kept inside the limits: {'; '.join(left)}")
    if not tests:
        raise UserError(
            "no test stays inside the limits in the model and the wrong ones: widen "
            "--margin, --travel or --max-speed, or try --play feed-forward"
        )
    return tests


if __name__ == "__main__":
    main(Config, run, name="train.excite")
