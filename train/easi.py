"""``python -m train.easi``: identify a simulator, then train the policy in it."""

from dataclasses import replace

from train._command import main, say
from train._easi_config import Config
from train._inputs import files_of


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
    if config.data and config.env and not config.policy:
        raise UserError("--env goes without --data: give --model and --parameters")
    if config.data:
        from train import _from_logs, _from_policy

        if config.target_effects:
            raise UserError("--target-effects goes without --data: logs have their own")
        for option in ("policy_seed", "observed", "sampled", "stand"):
            if getattr(config, option) not in (None, False, ()) and not config.policy:
                flag = "--" + option.replace("_", "-")
                raise UserError(f"{flag} goes with --policy: give the policy, too")
        (_from_policy if config.policy else _from_logs).run(config)
        return
    only = ("model", "parameters", "mapping", "held_out", "robot", "policy")
    for option in (*only, "policy_seed", "observed", "sampled", "stand"):
        if getattr(config, option) not in (None, False, ()):
            flag = "--" + option.replace("_", "-")
            raise UserError(f"{flag} goes with --data LOG: give the measured logs too")
    _from_target(config)


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
