"""Blocks of a study, or other independent tasks, on a Dask cluster. Only this file imports Dask.

A block is a pure function of the plan; if its worker is lost, it is computed again elsewhere with the same numbers.
Dask schedules the work and handles lost workers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import torch

from fdi_torch.study.monte_carlo import Trial, run_block
from fdi_torch.study.study_plan import Block, Plan

if TYPE_CHECKING:
    from distributed import Client

R = TypeVar("R")
LOCAL = "local"
LOOPBACK = "127.0.0.1"  # address of a local cluster, not reachable from other machines
CONNECT_SECONDS = 10.0  # to wait for a scheduler
# Number of lost workers per block after which the study fails.
LOST_WORKERS = 20


def run_on_cluster(plan: Plan, blocks: Iterable[Block], address: str) -> Iterator[list[Trial]]:
    """Yield the blocks as they are completed, in any order. address: of a Dask scheduler (tcp://...), or 'local'.

    Raises ValueError if Dask is not installed or no scheduler answers.
    """
    with connected(address) as client:
        yield from each_on(client, run_block, blocks, plan)


def each_on(client: Client, work: Callable[..., R], items: Iterable[Any], *shared: Any) -> Iterator[R]:
    """Yield work(*shared, item) of each item as it is completed. Exceptions of the work are raised.

    shared: objects that are sent to each worker once.
    """
    from distributed import as_completed

    sent = [client.scatter(each, broadcast=True, hash=False) for each in shared]
    for done in as_completed([client.submit(_alone, work, *sent, item, pure=False) for item in items]):
        yield done.result()
        done.release()


@contextmanager
def connected(address: str, workers: int | None = None) -> Iterator[Client]:
    """Client of a scheduler at an address, or of local worker processes. Raises ValueError without Dask or scheduler.

    A scheduler must be trusted: it and its workers send objects that are unpickled here.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise ValueError("expected Dask for --cluster, got none; pip install 'fdi_torch[cluster]'") from error
    dask.config.set({"distributed.scheduler.allowed-failures": LOST_WORKERS})
    if address == LOCAL:
        with (
            LocalCluster(n_workers=workers, threads_per_worker=1, host=LOOPBACK, dashboard_address=None) as cluster,
            Client(cluster) as client,
        ):
            yield client
        return
    try:
        client = Client(address, timeout=CONNECT_SECONDS)
    except (OSError, ValueError) as error:
        raise ValueError(
            f"expected a Dask scheduler at {address}, got no answer; give its address as in tcp://host:8786, or 'local'"
        ) from error
    with client:
        yield client


def _alone(work: Callable[..., R], *arguments: Any) -> R:
    """A worker uses one core, because its neighbours use the others."""
    torch.set_num_threads(1)
    return work(*arguments)
