"""Rows of a simulator on the nodes of a cluster."""

import time

import joblib
import numpy as np
import pytest
import torch

from gpadjust import BlackBoxPhysics, PhysicsError


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Ray
def test_rows_run_on_both_nodes_of_a_cluster():
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster
    from ray.util.joblib import register_ray

    class UnpicklableError(Exception):
        def __init__(self, code, reason):
            super().__init__(f"{reason} ({code})")

    def simulator(x):
        if x[0] > 90:
            raise UnpicklableError(7, "no solution here")
        time.sleep(0.3)  # or one node does all while the other starts
        ray_node = ray.get_runtime_context().get_node_id()
        return [x[0] ** 2, float(int(ray_node[:8], 16))]

    physics = BlackBoxPhysics(simulator, batched=False)
    ray.shutdown()  # of what another test of the process has opened
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        cluster.add_node(num_cpus=1)
        ray.init(address=cluster.address, log_to_driver=False)
        cluster.wait_for_nodes()
        register_ray()
        X = torch.arange(16.0).double().unsqueeze(-1)
        one_each = {"num_cpus": 1}  # or a node may get both workers
        with joblib.parallel_config(backend="ray", n_jobs=2, ray_remote_args=one_each):
            values = physics(X)
            with pytest.raises(
                PhysicsError, match=r"UnpicklableError: no solution here \(7\)"
            ) as caught:
                physics(X + 80)
        assert len(caught.value.rows) == 5
    finally:
        ray.shutdown()
        cluster.shutdown()
    np.testing.assert_allclose(values[:, 0], X[:, 0] ** 2)
    assert len(values[:, 1].unique()) == 2
