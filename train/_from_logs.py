"""Identifies a machine from measured logs; what ``train.easi --data`` does."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from train._command import say, show_table
from train._effects import read_given
from train._inputs import files_of
from train._log_problem import read_problem

if TYPE_CHECKING:
    from easi_jax.estimation.problem import Problem


def run(config: Any) -> None:
    """Reads, searches, finishes and reports; ``config`` is that of ``train.easi``."""
    problem = read_problem(config)
    seeds = config.seeds or (0,)
    from easi_jax.io.runs.folder import RunFolder
    from easi_jax.search.easi import Search

    search = Search(problem.simulator, _settings(config, problem))

    with RunFolder.open(
        config.out,
        read_given(config).recorded(config),
        command="train.easi",
        resume=config.resume,
        overwrite=config.overwrite,
        files=files_of(config),
    ) as folder:
        from easi_jax.devices.distributed import started
        from easi_jax.estimation.from_runs import ready_finish, search_data
        from easi_jax.estimation.held_out import ready_errors
        from easi_jax.estimation.posterior import sound
        from train._log_results import write

        refines = config.refine and search.config.finish
        finish = started(
            lambda: ready_finish(problem, search, refines, config.restarts or 0, say)
        )
        data = search_data(problem)
        states = searched(folder, config, search, data, problem.notes, seeds)
        several = len(seeds) > 1
        errors = started(lambda: ready_errors(problem, search.space, several))
        estimates, notes_of = finish()(states.result_mean, states.result_cov)
        good, lost = sound(seeds, estimates, search.space.names)
        places = [seeds.index(seed) for seed in good]
        report = write(
            *(folder, problem, search.space, search.config.generations),
            *(list(good.values()), list(good), errors(), lost),
            lambda best: notes_of(places[best]),
        )
    show(problem.name, report, config.out)


def _settings(config: Any, problem: "Problem") -> Any:
    """Search settings; as many pieces a generation as their length lets pay."""
    from easi_jax.errors import UserError
    from easi_jax.estimation.from_runs import replayed
    from train._robots import chosen_search

    # Nobody knows what a controller saw where these logs were recorded.
    chosen = chosen_search(
        config, source="replay", horizon=problem.piece, observation_inputs=False
    )
    if chosen.source != "replay" or chosen.policy_updates_per_generation:
        raise UserError(
            "logs come without their controller: leave source and "
            "policy_updates_per_generation alone with --data"
        )
    if any(s.startswith("segments=") for s in config.set):
        return chosen
    return replayed(problem, chosen)


def searched(
    folder: Any,
    config: Any,
    search: Any,
    data: Any,
    notes: list[str],
    seeds: Sequence[int],
) -> Any:
    """The search of each of ``seeds`` to its end, in chunks that are resumed."""
    import jax

    from easi_jax.devices.runtime import fast_loops, quick_compile
    from easi_jax.pipeline.stages import seed_keys
    from easi_jax.simulation.compile_time import expected
    from train._stages import jit_chunks, run_stage, search_check, search_rows

    keys = seed_keys(list(seeds))
    advance = jit_chunks(
        lambda states, data, n: jax.lax.map(lambda s: search.run(s, data, n), states),
        fast_loops() | quick_compile(),
    )
    return run_stage(
        folder,
        "search",
        search.config.generations,
        config.search_chunk,
        lambda: jax.lax.map(lambda k: search.init(k, data), keys),
        lambda states, n: advance(states, data, n),
        search_rows(seeds, search.space.names, search.space.to_si),
        notes,
        search_check(seeds, search.space.names, search.config.population),
        seconds=expected(search.simulator),
    )


def show(name: str, report: Any, out: Any) -> None:
    """Says what was found, what is to be doubted, and where the report is."""
    from easi_jax.io.report.parameters import parameter_table

    show_table(f"Parameters of {name}", *parameter_table(report.parameters))
    errors = report.tables[0]
    show_table(errors.title, errors.columns, errors.rows)
    for found in report.diagnostics:
        if not found.ok:
            more = f" ({found.note})" if found.note else ""
            say(f"note: {found.label}: {found.value}{more}")
    for note in (*report.undetermined, *report.notes):
        say(f"note: {note}")
    say(f"a policy for it: python -m train.udr --env FILE.py --found {out} ...")
    say(f"report: {out / 'report.html'}")
