"""Who does the work of sweeps and catalogues: this machine's cores, or a cluster's."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from cyclopts import Parameter

if TYPE_CHECKING:
    from gradcal_jax.jobs.cluster import Cluster
    from gradcal_jax.jobs.pool import LocalPool


@Parameter(name="*")
@dataclass(frozen=True)
class Workers:
    """Who does it.

    Parameters
    ----------
    scheduler
        Address of a Dask scheduler, such as tcp://host:8786; without it the cores of this machine do the work.
    workers
        Worker processes on this machine; as many as cores.
    """

    scheduler: str | None = None
    workers: int | None = None

    def check(self) -> None:
        """Refuse what cannot be meant. Raises `ValueError`."""
        if self.workers is not None and not 1 <= self.workers <= 1024:
            raise ValueError(f"--workers {self.workers}: give a number from 1 to 1024")
        if self.workers is not None and self.scheduler is not None:
            raise ValueError("--workers or --scheduler: a cluster decides for itself how many it has")

    def runner(self) -> "LocalPool | Cluster":
        """The machine's own workers, which keep compiled programs where the other commands do, or a cluster's."""
        if self.scheduler is not None:
            from gradcal_jax.jobs.cluster import Cluster

            return Cluster(self.scheduler)
        from gradcal_jax.cache import cache_folder
        from gradcal_jax.jobs.pool import LocalPool

        folder = cache_folder()
        return LocalPool(self.workers, None if folder is None else str(folder))


THIS_MACHINE: Final = Workers()
