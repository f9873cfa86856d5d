"""Plans by gradient descent: free coordinates, criteria, the search, and a proven limit."""

from gradcal_jax.design.coordinates import Coordinates, Cycle, Element, Limits
from gradcal_jax.design.criteria import Criterion, criterion
from gradcal_jax.design.limit import Limit, least_noise_density, limit
from gradcal_jax.design.search import Found, Progress, polish, search

__all__ = [
    "Coordinates",
    "Criterion",
    "Cycle",
    "Element",
    "Found",
    "Limit",
    "Limits",
    "Progress",
    "criterion",
    "least_noise_density",
    "limit",
    "polish",
    "search",
]
