"""Who does the work of sweeps and catalogues: this machine's cores, or a cluster's."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gradcal_jax.jobs.cluster import Cluster
    from gradcal_jax.jobs.pool import LocalPool


def check_workers(scheduler: str | None, workers: int | None) -> None:
    """Refuse what cannot be meant. Raises `ValueError`."""
    if workers is not None and not 1 <= workers <= 1024:
        raise ValueError(f"--workers {workers}: give a number from 1 to 1024")
    if workers is not None and scheduler is not None:
        raise ValueError("--workers or --scheduler: a cluster decides for itself how many it has")


def runner_for(scheduler: str | None, workers: int | None) -> "LocalPool | Cluster":
    """The machine's own workers, which keep compiled programs where the other commands do, or a cluster's."""
    if scheduler is not None:
        from gradcal_jax.jobs.cluster import Cluster

        return Cluster(scheduler)
    from gradcal_jax.cache import cache_folder
    from gradcal_jax.jobs.pool import LocalPool

    folder = cache_folder()
    return LocalPool(workers, None if folder is None else str(folder))
