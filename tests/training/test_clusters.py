"""Jobs on real clusters of Dask's and Ray's, which run on this machine here: as in worker processes, file for file."""

import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from busy_jobs import Busy, alive, until, work

from training.parallel import engine

distributed = pytest.importorskip("distributed")
ray = pytest.importorskip("ray")

needs_proc = pytest.mark.skipif(not Path("/proc").exists(), reason="looks processes up in /proc")
# What the libraries themselves leave open when a cluster ends.
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")


@pytest.fixture(scope="module")
def dask_cluster():
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster:
        yield "dask", cluster.scheduler_address


@pytest.fixture(scope="module")
def ray_cluster():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_AUTH_MODE", "disabled")
        ray.init(num_cpus=2, include_dashboard=False, object_store_memory=100 * 2**20, log_to_driver=False)
        address = ray.get_runtime_context().gcs_address
        yield "ray", address
        ray.shutdown()


@pytest.fixture(params=["dask", "ray"])
def cluster(request):
    return request.getfixturevalue(f"{request.param}_cluster")
