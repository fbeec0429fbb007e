"""EASI's search: one generation, evolution, discriminator."""

from easi_jax.search.config import SearchConfig
from easi_jax.search.easi import Search, SearchData, SearchInfo, SearchState

__all__ = ["Search", "SearchConfig", "SearchData", "SearchInfo", "SearchState"]
