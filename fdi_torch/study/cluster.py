"""The blocks of a study, or other independent work, on a Dask cluster. The only importer of the distributed engine.

A block is a pure function of the plan, so that one whose worker was lost is simply computed again elsewhere, with the
same numbers. Which worker does what, when, and what to do about lost ones is left to Dask.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

import torch

from fdi_torch.study.monte_carlo import Trial, run_block
from fdi_torch.study.plan import Block, Plan

if TYPE_CHECKING:
    from distributed import Client

T = TypeVar("T")
R = TypeVar("R")
LOCAL = "local"
LOOPBACK = "127.0.0.1"  # where a local cluster listens, and nobody else can reach it
# A block may lose its worker this often before the study gives up.
LOST_WORKERS = 20


def run_on_cluster(
    plan: Plan, blocks: Iterable[Block], address: str, workers: int | None = None
) -> Iterator[list[Trial]]:
    """The blocks as they get done, in any order. address: of a Dask scheduler (tcp://...), or 'local'.

    workers: of a local cluster, one a core where not given. Raises ValueError where Dask is not installed or nobody
    answers at the address.
    """
    with connected(address, workers) as client:
        yield from run_with(client, plan, blocks)


def run_with(client: Client, plan: Plan, blocks: Iterable[Block]) -> Iterator[list[Trial]]:
    """The same on a cluster that is connected already."""
    from distributed import as_completed

    shared = client.scatter(plan, broadcast=True, hash=False)
    tasks = [client.submit(_on_worker, shared, block, pure=False, key=_key(block)) for block in blocks]
    for done in as_completed(tasks):
        yield done.result()
        done.release()


def each_on(client: Client, work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """work(item) of each item, as they get done. Raises what a piece of work raises."""
    from distributed import as_completed

    for done in as_completed([client.submit(_alone, work, item, pure=False) for item in items]):
        yield done.result()
        done.release()


@contextmanager
def connected(address: str, workers: int | None = None) -> Iterator[Client]:
    """A scheduler at an address, or so many worker processes here. Raises ValueError without Dask or a scheduler.

    A scheduler is trusted: it and its workers send objects that are unpickled here.
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
        client = Client(address, timeout="10s")
    except (OSError, ValueError) as error:
        raise ValueError(
            f"expected a Dask scheduler at {address}, got no answer; give its address as in tcp://host:8786, or 'local'"
        ) from error
    with client:
        yield client


def _on_worker(plan: Plan, block: Block) -> list[Trial]:
    """Each worker has one core; its neighbours have the others."""
    torch.set_num_threads(1)
    return run_block(plan, block)


def _alone(work: Callable[[T], R], item: T) -> R:
    torch.set_num_threads(1)
    return work(item)


def _key(block: Block) -> str:
    return f"block-{block.setting}-{block.first}-{block.last}"
