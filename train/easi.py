"""``python -m train.easi``: identify a simulator, then train the policy in it."""

from collections.abc import Sequence
from dataclasses import replace

from train._command import main, say
from train._easi_config import Config
from train._found import FILE
from train._inputs import files_of

# Options that say something of logs alone, of a policy that made them, of a target.
_OF_LOGS = "model", "parameters", "mapping", "held_out", "robot", "policy"
_OF_LOGS += "held_base", "unmeasured", "allow_assets"
_OF_POLICIES = "policy_seed", "observed", "sampled", "stand"
_OF_TARGETS = "udr", "target", "target_effects", "oracle", "trajectories"
_OF_TARGETS += "warm_start", "eval_episodes", "chunk"


def run(config: Config) -> None:
    """Identifies from logs, or from a pseudo-real target."""
    from easi_jax.errors import UserError
    from train._robots import check_chunk, check_seeds

    check_chunk(config.chunk)
    check_chunk(config.search_chunk)
    if config.seeds:
        check_seeds(config.seeds)
    if config.restarts is not None and config.restarts < 0:
        raise UserError(f"--restarts is {config.restarts}: give 0 or more")
    if not config.data:
        why = "goes with --data LOG: give the measured logs too"
        _refuse(config, (*_OF_LOGS, *_OF_POLICIES), why)
        _from_target(config)
        return
    _refuse(config, _OF_TARGETS, "goes without --data: logs stand for the target")
    if not config.policy:
        _refuse(config, _OF_POLICIES, "goes with --policy: give the policy, too")
        why = "goes without --data: give --model and --parameters"
        _refuse(config, ("env",), why)
    from train import _from_logs, _from_policy

    (_from_policy if config.policy else _from_logs).run(config)


def _refuse(config: Config, options: Sequence[str], why: str) -> None:
    """Refuses options that would do nothing."""
    from easi_jax.errors import UserError

    plain = Config()
    for option in options:
        if getattr(config, option) != getattr(plain, option):
            no = "no-" if option == "warm_start" else ""
            raise UserError(f"--{no}{option.replace('_', '-')} {why}")


def _from_target(config: Config) -> None:
    """Demonstrations, search, final training and evaluation, each resumable."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.errors import UserError
    from easi_jax.io.runs.folder import RunFolder
    from easi_jax.pipeline.stages import seed_keys
    from train._chain import Chunked, ready, write_and_show
    from train._effects import effect_notes, read_given
    from train._robots import load_udr
    from train._stages import training_curve

    if (config.udr / FILE).is_file():
        raise UserError(
            f"{config.udr} was trained under what a run of train.easi found: give a "
            "run of train.udr without --found"
        )
    udr = load_udr(config.udr, config.env)
    seeds = config.seeds or udr["seeds"]
    missing = [s for s in seeds if s not in udr["seeds"]]
    if missing:
        raise UserError(
            f"{config.udr} has no policy of seed {missing[0]}: it holds seeds "
            f"{list(udr['seeds'])}"
        )
    given, theirs = read_given(config), udr["given"]
    if given.effects is None:
        given = replace(given, effects=theirs.effects)
    option = udr["config"].get("option", ())
    setup = ready(
        *(config, udr["env"], given, udr["training"], seeds, option, config.horizon)
    )
    if setup.pipe.search.trainer and given.effects != theirs.effects:
        raise UserError(
            "policy_updates_per_generation goes on with the training of the UDR run: "
            "run train.udr with the same --effects"
        )
    index = np.array([udr["seeds"].index(s) for s in seeds])
    states = jax.tree.map(lambda x: x[index], udr["states"])
    with RunFolder.open(
        config.out,
        given.recorded(config),
        command="train.easi",
        resume=config.resume,
        overwrite=config.overwrite,
        files=files_of(config),
    ) as folder:
        notes = effect_notes(given)
        out = setup.pipe.chain(
            seed_keys(list(seeds)),
            jnp.asarray(setup.theta, jnp.float32),
            Chunked(setup, folder, config.chunk, config.search_chunk, notes),
            states,
            config.oracle,
        )
        methods = {"udr": udr["method"], "easi": "EASI"}
        curves = {}
        same = theirs.target_effects == given.target_effects
        if same and udr["config"]["target"] == list(setup.changes):
            curves[udr["method"]] = training_curve(config.udr, "train", seeds)
        curves["EASI"] = training_curve(folder.path, "final", seeds)
        if config.oracle:
            methods["oracle"] = "Oracle"
            curves["Oracle"] = training_curve(folder.path, "oracle", seeds)
        write_and_show(folder, "train.easi", setup, out, methods, curves, notes)
    say(f"report: {config.out / 'report.html'}")


if __name__ == "__main__":
    main(Config, run, name="train.easi")
