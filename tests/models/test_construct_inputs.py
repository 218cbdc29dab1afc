"""Models from BoTorch's datasets."""

import torch
from botorch.utils.datasets import SupervisedDataset


def test_a_model_from_a_dataset(data, build, kind, num_outputs, crude_physics, uniform):
    X, Y = data(num_outputs=num_outputs)
    direct = build(kind, X, Y).eval()
    dataset = SupervisedDataset(
        X, Y, feature_names=["a", "b"], outcome_names=[f"y{i}" for i in range(num_outputs)]
    )
    options = {}
    if kind != "ZeroMeanGP":
        options["physics"] = lambda X: crude_physics(X)[:, :num_outputs]
    arguments = type(direct).construct_inputs(dataset, **options)
    if kind == "AR1":
        arguments |= {"bounds": torch.tensor([[0.0, 0.0], [2.0, 2.0]]), "num_low": 12}
    if kind.startswith("RRA"):
        arguments["num_features"] = 24
    if kind == "RRA-paper":
        arguments["prior"] = "paper"
    Z = uniform(4, 2)
    model = type(direct)(**arguments).eval()
    torch.testing.assert_close(model.posterior(Z).mean, direct.posterior(Z).mean)


def test_known_noise_is_passed_on(data, build, crude_physics, uniform):
    X, Y = data()
    Yvar = uniform(*Y.shape, low=0.01, high=0.1)
    direct = build("CKA", X, Y, Yvar).eval()
    dataset = SupervisedDataset(X, Y, feature_names=["a", "b"], outcome_names=["y"], Yvar=Yvar)
    arguments = type(direct).construct_inputs(dataset, physics=lambda X: crude_physics(X)[:, :1])
    model = type(direct)(**arguments).eval()
    Z = uniform(4, 2)
    torch.testing.assert_close(model.posterior(Z).variance, direct.posterior(Z).variance)
