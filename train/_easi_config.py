"""Options of ``train.easi``."""

import dataclasses
from pathlib import Path


@dataclasses.dataclass(frozen=True)
class Config:
    """Finds the distribution of physical parameters under which simulation looks like
    the measured motion (EASI), and trains the final policy under it.

    With a built-in robot, the policy of ``train.udr`` records demonstrations in a
    pseudo-real target, the search never sees the target's parameters, and the final
    policy is tested there against the first (and, with --oracle, against a policy
    trained in the target itself). With --data, logs of a real machine take the
    target's place: give --model and --parameters for a machine of your own.
    """

    udr: Path = Path("results/udr")
    """Run folder of train.udr: its policy records the demonstrations."""
    env: Path | None = None
    """The Python file of your own environment, where train.udr was run with one."""
    out: Path = Path("results/easi")
    """Folder of the run."""
    target: tuple[str, ...] | None = None
    """The pseudo-real robot: parameters that differ from the nominal ones, as
    NAME*FACTOR or NAME=VALUE; not given: half of what the paper's Fig. 6 changes, such
    as cart_kp*0.5 for cartpole."""
    effects: Path | None = None
    """Effects that the model lacks (effects.yaml of train.gap): the model gets them,
    and their parameters are searched with the others; not given: those of the UDR run.
    """
    target_effects: Path | None = None
    """An effects file for the pseudo-real robot alone: it has these effects whether
    --effects names them or not (without --target, nothing else differs)."""
    data: tuple[Path, ...] = ()
    """Measured logs (CSV, NPZ or Parquet) in place of a pseudo-real target."""
    held_out: tuple[Path, ...] = ()
    """Logs kept out of the search, to test the result on."""
    model: Path | None = None
    """MuJoCo model (MJCF) of the machine that the logs are of."""
    allow_assets: tuple[Path, ...] = ()
    """Files, or folders with all below them, that the model may read besides those in
    its own folder (meshes, textures, includes)."""
    parameters: Path | None = None
    """Parameter file (YAML): what may vary in the model, and in which range."""
    mapping: Path | None = None
    """Mapping file (YAML) for logs with foreign column names."""
    robot: str | None = None
    """Built-in robot that the logs are of, in place of --model and --parameters."""
    preset: str = "default"
    """Search settings: default, or paper (the reference's recipe, defects included)."""
    strategy: str | None = None
    """Evolution strategy: mu_lambda, CMA_ES, Sep_CMA_ES, SNES, ..."""
    generations: int | None = None
    """Generations of the search (preset: 50)."""
    population: int | None = None
    """Individuals in a generation (preset: 300)."""
    set: tuple[str, ...] = ()
    """Further search settings, NAME=VALUE: loss=gan, regularizer=gradient_penalty,
    innovation_inputs=false, policy_updates_per_generation=20, ..."""
    start: tuple[float, float] | None = None
    """Where the search starts, as factors on the nominal values; not given: where UDR
    trained."""
    refine: bool = True
    """Finish with least squares on the paired data."""
    restarts: int | None = None
    """More starts of the least-squares finish, drawn from the search's spread; the best
    fit counts. Not given: 2 for noisy data, none for clean ones, larger robots and
    logs."""
    trajectories: int = 200
    """Demonstration trajectories."""
    noise: tuple[float, ...] = ()
    """Sensor noise (standard deviations of positions, then velocities, SI): added to
    pseudo-real demonstrations; for logs it is estimated where not given."""
    horizon: float | None = None
    """Seconds of motion that a measured piece holds; not given: one control step for
    clean demonstrations, as many as the noise asks for otherwise."""
    warm_start: bool = False
    """Final training goes on from the networks of the UDR policy in place of new ones
    (the Oracle's, too): it gets further where a training of its length has not settled.
    """
    oracle: bool = False
    """Train the Oracle too: a policy trained in the target itself."""
    seeds: tuple[int, ...] = ()
    """Seeds; not given: those of the UDR run (0 for logs)."""
    eval_episodes: int = 100
    """Episodes of the final evaluation."""
    chunk: int | None = None
    """Training iterations between checkpoints; about 50,000 control steps where not
    given."""
    search_chunk: int = 10
    """Generations between checkpoints."""
    resume: bool = False
    """Go on with the run in the folder."""
    overwrite: bool = False
    """Delete the run in the folder first."""
    distributed: bool = False
    """One of several processes (srun, mpirun, Kubernetes) whose devices share the
    work."""
