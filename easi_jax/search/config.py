"""What a search is made of; every mended defect of the reference is a switch."""

from dataclasses import dataclass, replace

from easi_jax.errors import UserError, nearest

LOSSES = "wasserstein", "gan"
REGULARIZERS = "clip", "gradient_penalty", "none"


@dataclass(frozen=True)
class SearchConfig:
    """Settings of the EASI search (Algorithm 1). Presets: `default`, `paper`."""

    strategy: str = "mu_lambda"
    """Evolution strategy: mu_lambda, or a name of evosax's registry (CMA_ES, ...)."""
    population: int = 300
    """Individuals in a generation."""
    generations: int = 50
    """Generations to run."""
    elite_ratio: float = 0.5
    """Share of the population that is recombined (mu / lambda), for mu_lambda."""
    source: str = "replay"
    """replay: logged commands from logged states; policy: roll the controller out."""
    horizon: int = 1
    """Control steps in a replayed piece."""
    segments: int = 128
    """Measured pieces replayed by every individual of a generation."""
    rollout_steps: int = 200
    """Control steps of a policy rollout."""
    discriminator_updates: int = 20
    """Gradient steps of the discriminator in a generation."""
    real_batch: int = 4800
    """Measured transitions in one discriminator step."""
    fake_per_individual: int = 8
    """Simulated transitions per individual in one discriminator step."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the discriminator's layers."""
    loss: str = "wasserstein"
    """wasserstein (Eq. 4) or gan (Eq. 3)."""
    regularizer: str = "clip"
    """clip (weights to +-0.01), gradient_penalty, or none."""
    learning_rate: float = 3e-4
    """RMSprop step of the discriminator (see steady_learning)."""
    policy_updates_per_generation: int = 0
    """Policy training steps under the current distribution in each generation."""

    innovation_inputs: bool = True
    """Show the discriminator s' minus the mean model's prediction, in units of the
    spread of what is measured and simulated, instead of s'."""
    delta_inputs: bool = True
    """Show s' - s instead of s' (where innovation_inputs is off)."""
    observation_inputs: bool = False
    """Show what the controller sees and does (observation, action, next observation)
    in place of state and commands; for source policy, without innovation_inputs and
    delta_inputs."""
    standardize_inputs: bool = True
    """Standardize the discriminator's inputs by the measured data."""
    steady_learning: bool = True
    """With other than 20 discriminator_updates, scale the learning rate such that a
    generation moves the discriminator as far as with 20."""
    clip_after_update: bool = True
    """Clip discriminator weights after each step (Algorithm 1), not before."""
    epsilon_in_root: bool = True
    """RMSprop divides by sqrt(v + 1e-8), not by sqrt(v) + 1e-8."""
    half_loss: bool = False
    """Half of Eq. 4; RMSprop's step hardly changes by it."""
    positive_weights: bool = True
    """With an elite_ratio above a half, individuals of the worse half weigh nothing
    in the recombination (their weights are negative otherwise)."""
    uniform_first_generation: bool = True
    """Evaluate a truly uniform first generation, not a moment-matched Gaussian."""
    last_evaluation: bool = True
    """Let the result use the last generation's evaluation."""
    respect_bounds: bool = True
    """Keep individuals and samples of the result inside the physical bounds."""
    mask_resets: bool = True
    """No transition crosses a reset; otherwise trajectories that run the controller go
    on after one, and the discriminator sees the transition across."""
    stale_first_observation: bool = False
    """At a trajectory's first step the controller sees the end of the trajectory
    before (nothing, zeros, before the first); goes with observation_inputs."""
    common_random_numbers: bool = True
    """Same starts and noise for all individuals of a generation."""
    spread_about: str = "old_mean"
    """Measure the spread about the old_mean (keeps it while moving) or new_mean."""
    informed_spread: bool = True
    """Give the result the initial spread along what the data leave open."""
    log_scale: bool = True
    """Search positive parameters on a logarithmic scale."""
    finish: bool = True
    """Least squares on paired data may follow the search."""
    goes_on: bool = True
    """The policy's final training may go on from the first policy's networks."""

    def __post_init__(self) -> None:
        """Checks names and sizes; raises UserError."""
        choices = {
            "source": ("replay", "policy"),
            "loss": LOSSES,
            "regularizer": REGULARIZERS,
            "spread_about": ("old_mean", "new_mean"),
        }
        for field, known in choices.items():
            value = getattr(self, field)
            if value not in known:
                raise UserError(
                    f'search {field} is "{value}" (known: {", ".join(known)})'
                    f"{nearest(value, known)}"
                )
        for field in (
            "population",
            "generations",
            "horizon",
            "segments",
            "rollout_steps",
            "real_batch",
            "fake_per_individual",
        ):
            if getattr(self, field) < 1:
                raise UserError(
                    f"search {field} is {getattr(self, field)}: give at least 1"
                )
        others = self.innovation_inputs or self.delta_inputs or self.source != "policy"
        if self.observation_inputs and others:
            raise UserError(
                "search observation_inputs shows what a controller sees: it goes with "
                "source=policy, innovation_inputs=false and delta_inputs=false"
            )
        if self.stale_first_observation and not self.observation_inputs:
            raise UserError(
                "search stale_first_observation goes with observation_inputs=true"
            )
        if self.population < 4:
            raise UserError(f"search population is {self.population}: give at least 4")
        if not 0 < self.elite_ratio <= 1:
            raise UserError(
                f"search elite_ratio is {self.elite_ratio}: give a share in (0, 1]"
            )

    @property
    def crosses_resets(self) -> bool:
        """Whether trajectories go on after a reset."""
        return self.source == "policy" and not self.mask_resets


DEFAULT = SearchConfig()

PAPER = SearchConfig(
    source="policy",
    hidden=(128, 128),
    fake_per_individual=16,
    discriminator_updates=10,
    innovation_inputs=False,
    delta_inputs=False,
    observation_inputs=True,
    standardize_inputs=False,
    steady_learning=False,
    clip_after_update=False,
    epsilon_in_root=False,
    half_loss=True,
    positive_weights=False,
    uniform_first_generation=False,
    last_evaluation=False,
    respect_bounds=True,
    mask_resets=False,
    common_random_numbers=False,
    spread_about="new_mean",
    informed_spread=False,
    log_scale=False,
    finish=False,
    goes_on=False,
)
"""The reference's recipe, defects included, with Cartpole's 10 discriminator steps
(Ant and Ballbalance have 20; commands know)."""

PRESETS = {"default": DEFAULT, "paper": PAPER}


def preset(name: str, **changes: object) -> SearchConfig:
    """A preset with some fields changed.

    Raises:
        UserError: no preset of that name.
    """
    if name not in PRESETS:
        raise UserError(
            f'unknown preset "{name}" (known: {", ".join(PRESETS)})'
            f"{nearest(name, PRESETS)}"
        )
    return replace(PRESETS[name], **changes)  # type: ignore[arg-type]
