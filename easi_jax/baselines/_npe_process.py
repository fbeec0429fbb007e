"""Trains a posterior with sbi: ``python _npe_process.py IN.npz OUT.npz``.

Run by `easi_jax.baselines.npe` as a file, so that nothing here imports jax.
"""

import sys
from typing import Any

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from sbi.inference import NPE  # pyright: ignore[reportMissingImports]


def main(source: str, target: str) -> None:
    """From simulations and an observation to the posterior's mean and covariance."""
    with np.load(source) as file:
        given = dict(file)
    torch.manual_seed(int(given["seed"]))
    torch.set_num_threads(1)  # small networks: more would wait for each other

    def tensor(name: str) -> torch.Tensor:
        return torch.as_tensor(given[name], dtype=torch.float32)

    prior = torch.distributions.MultivariateNormal(
        tensor("prior_mean"), torch.diag(tensor("prior_std") ** 2)
    )
    density: Any = str(given["density"])  # sbi says which names there are
    trainer = NPE(prior, density_estimator=density, show_progress_bars=False)
    trainer.append_simulations(tensor("units"), tensor("summaries")).train()
    posterior = trainer.build_posterior()
    drawn = posterior.sample(
        (int(given["samples"]),), x=tensor("observed"), show_progress_bars=False
    ).numpy()
    cov = np.cov(drawn, rowvar=False).reshape(drawn.shape[1], -1)
    np.savez(target, mean=drawn.mean(0), cov=cov)


if __name__ == "__main__":
    main(*sys.argv[1:])
