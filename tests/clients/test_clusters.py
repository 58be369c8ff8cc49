"""Dask and Ray: workers get systems that a notebook defines by value."""

import gymnasium as gym
import pytest
from notebook_systems import springs

pytestmark = pytest.mark.clients


@pytest.fixture
def on_dask():
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield lambda function, *args: client.submit(function, *args).result()


@pytest.fixture
def on_ray():
    ray = pytest.importorskip("ray")
    ray.init(num_cpus=1, include_dashboard=False)
    yield lambda function, *args: ray.get(ray.remote(function).remote(*args))
    ray.shutdown()


@pytest.mark.parametrize("cluster", ["on_dask", "on_ray"])
def test_workers_run_systems_that_a_notebook_defines(cluster, request):
    def start(system):
        return gym.make("kkl_gym:kkl_gym/Own-v0", system=system).reset(seed=0)[0].tolist()

    run, (plain, frozen) = request.getfixturevalue(cluster), springs()
    assert [run(start, system) for system in (plain, frozen(k=3.0))] == [start(plain), start(frozen(k=3.0))]
