"""The layer and coarse floating-point types: what it returns passes the shield's test as it is, or it says why not."""

import numpy as np
import pytest
import torch
from torch import nn

from ncs_gym import truck_trailer
from shields import SafetyFilter
from shields.torch import SafeLayer
from tests.certificates import certificate_of
from tests.plants import random_plant

COARSE = [torch.float16, torch.bfloat16, torch.float8_e4m3fn]
PLANTS = {"one input": truck_trailer(mass=4000.0), "two inputs": random_plant(0, 4, 2)}


@pytest.fixture(params=PLANTS)
def setting(request):
    """A layer, and estimates and proposals of which many have to be projected or replaced."""
    plant = PLANTS[request.param]
    layer = SafeLayer(certificate_of(plant), plant)
    rng = np.random.default_rng(1)
    estimates = 0.98 * layer.filter.certificate.ellipsoid.sample(rng, 300)
    return layer, torch.tensor(estimates), torch.tensor(rng.uniform(-1.3, 1.3, (300, plant.m)))


@pytest.mark.cases(3)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, *COARSE], ids=str)
def test_every_action_returned_is_admissible_as_it_is(setting, dtype):
    layer, estimates, proposals = setting
    shape = 0.2 * layer.filter.certificate.Sigma
    actions = proposals.to(dtype)
    safe = layer(actions, estimates, shape)
    assert safe.dtype is (dtype if dtype.itemsize >= 4 else torch.float32)
    inputs = layer.filter.plant.u_max * safe.double().numpy()
    decided = layer.filter.decide_many(
        estimates.numpy(), shape, layer.filter.plant.u_max * actions.double().clamp(-1, 1).numpy()
    )
    assert (decided.reason == "projected").sum() > 20
    judge = SafetyFilter(layer.filter.certificate, layer.filter.plant, "monitor")
    for x_hat, u, reason in zip(estimates.numpy(), inputs, decided.reason, strict=True):
        if reason == "fallback":
            fallback = layer.filter.fallback_input(x_hat)
            np.testing.assert_allclose(u, fallback, rtol=1e-7, atol=1e-7 * layer.filter.plant.u_max.max())
        else:
            assert judge.decide(x_hat, shape, u).reason == "safe"


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16], ids=str)
def test_layer_learns_under_autocast(setting, dtype):
    layer, estimates, _ = setting
    torch.manual_seed(0)
    model = nn.Linear(estimates.shape[1], layer.filter.plant.m)
    with torch.autocast("cpu", dtype=dtype):
        actions = model(estimates.float())
        assert actions.dtype is dtype
        safe = layer(actions, estimates)
        assert safe.dtype is torch.float32
        safe.square().sum().backward()
    own = layer(model(estimates.float()).detach(), estimates)
    assert model.weight.grad is not None
    assert torch.isfinite(model.weight.grad).all()
    assert model.weight.grad.abs().max() > 0.0
    np.testing.assert_allclose(safe.detach().numpy(), own.numpy(), atol=2e-2)


def test_gradient_of_a_coarse_action_is_that_of_a_fine_one(setting):
    layer, estimates, proposals = setting
    coarse = proposals.bfloat16().requires_grad_()
    fine = proposals.bfloat16().float().requires_grad_()
    for actions in (coarse, fine):
        layer(actions, estimates).sum().backward()
    assert coarse.grad is not None
    assert fine.grad is not None
    assert coarse.grad.dtype is torch.bfloat16
    np.testing.assert_array_equal(coarse.grad.float().numpy(), fine.grad.bfloat16().float().numpy())


def test_whole_numbers_and_negated_views_are_taken(setting):
    layer, estimates, proposals = setting
    whole = np.zeros(estimates.shape, np.int8)
    np.testing.assert_array_equal(layer(proposals, whole).numpy(), layer(proposals, whole.astype(float)).numpy())
    np.testing.assert_array_equal(layer(torch._neg_view(-proposals), estimates), layer(proposals, estimates))
