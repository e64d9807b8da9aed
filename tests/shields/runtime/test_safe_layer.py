"""The projection as a layer of PyTorch, and batches of decisions: equal to the shield's, with exact gradients."""

import numpy as np
import pytest
import torch

from ncs_gym import truck_trailer
from shields.torch import SafeLayer
from tests.certificates import certificate_of
from tests.plants import random_plant


@pytest.fixture(
    scope="module", params=["one input", "two inputs", "polytope", pytest.param("three inputs", marks=pytest.mark.slow)]
)
def setting(request):
    """A plant, its certificate, estimates, inputs and error shapes where many proposals are projected."""
    plant = {"one input": truck_trailer(mass=4000.0)}.get(request.param)
    if plant is None:
        plant = random_plant(0, 4, 3 if request.param == "three inputs" else 2)
    certificate = certificate_of(plant, safe_set="polytope" if request.param == "polytope" else "ellipsoid")
    rng = np.random.default_rng(0)
    estimates = 0.95 * certificate.ellipsoid.sample(rng, 60)
    if request.param == "polytope":
        estimates = 0.7 * plant.half_widths * rng.uniform(-1, 1, (60, plant.n))
    shapes = rng.uniform(0.01, 0.6, 60)[:, None, None] * certificate.Sigma
    return plant, certificate, estimates, shapes, rng.uniform(-1.3, 1.3, (60, plant.m))


def test_layer_applies_what_the_shield_applies(setting):
    plant, certificate, estimates, shapes, actions = setting
    layer = SafeLayer(certificate, plant)
    safe = layer(torch.tensor(actions), torch.tensor(estimates), torch.tensor(shapes))
    decided = layer.filter.decide_many(estimates, shapes, np.clip(actions, -1, 1) * plant.u_max)
    np.testing.assert_allclose(safe.numpy() * plant.u_max, decided.input, rtol=1e-12)
    assert (decided.reason == "projected").sum() >= 5
    assert (decided.reason == "safe").sum() >= 3
    single = layer(torch.tensor(actions, dtype=torch.float32), torch.tensor(estimates), torch.tensor(shapes))
    assert single.dtype is torch.float32
    own = layer(torch.tensor(actions), torch.tensor(estimates))
    assert not np.array_equal(own.numpy(), safe.numpy())


def test_gradients_are_those_of_the_projection(setting):
    plant, certificate, estimates, shapes, actions = setting
    layer, checked, curved = SafeLayer(certificate, plant), 0, 0
    steps = 1e-3 * np.eye(plant.m)  # much more than what rounding to float32 moves
    for x_hat, shape, action in zip(estimates, shapes, actions, strict=True):
        known = torch.tensor(x_hat[None]), torch.tensor(shape[None])

        def safe(each, known=known):
            return layer(torch.as_tensor(each)[None], *known)[0]

        jacobian = torch.autograd.functional.jacobian(safe, torch.tensor(action)).numpy()
        middle = safe(action).numpy()
        forward = np.array([safe(action + step).numpy() - middle for step in steps]).T / 1e-3
        backward = np.array([middle - safe(action - step).numpy() for step in steps]).T / 1e-3
        if np.abs(forward - backward).max() > 0.02:
            continue  # a constraint begins or ends to be active here
        np.testing.assert_allclose(jacobian, 0.5 * (forward + backward), atol=2e-3)
        checked += 1
        curved += 0.01 < np.abs(jacobian).max() < 0.99
    assert checked >= 45
    assert curved >= 3 or plant.m == 1


def test_fallback_has_no_gradient():
    plant = truck_trailer(mass=4000.0)
    layer = SafeLayer(certificate_of(plant), plant)
    actions = torch.zeros((2, 1), requires_grad=True)
    layer(actions, torch.tensor([[9.0, 0.0], [0.1, 0.0]])).sum().backward()
    assert actions.grad is not None
    np.testing.assert_array_equal(actions.grad.numpy(), [[0.0], [1.0]])


def test_empty_batches_give_empty_ones(setting):
    plant, certificate, *_ = setting
    layer, empty = SafeLayer(certificate, plant), np.zeros((0, plant.n))
    many = layer.filter.decide_many(empty, certificate.Sigma, np.zeros((0, plant.m)))
    assert (many.input.shape, many.reason.shape, many.margin.shape) == ((0, plant.m), (0,), (0,))
    actions = torch.zeros((0, plant.m), requires_grad=True)
    safe = layer(actions, torch.tensor(empty))
    safe.sum().backward()
    assert safe.shape == (0, plant.m)


def test_what_has_no_numbers_to_decide_about_is_named(setting):
    plant, certificate, estimates, _, actions = setting
    layer = SafeLayer(certificate, plant)
    given = torch.tensor(actions[:3]), torch.tensor(estimates[:3])
    with pytest.raises(ValueError, match=r"what torch.func and torch.export transform, and the meta device"):
        torch.func.vmap(lambda u, x: layer(u[None], x[None])[0])(*given)


@pytest.mark.filterwarnings("ignore")  # torch's about traces
def test_trace_that_would_keep_one_decision_is_refused(setting):
    plant, certificate, estimates, _, actions = setting
    with pytest.raises(ValueError, match=r"torch\.jit\.trace cannot hold a SafeLayer"):
        torch.jit.trace(SafeLayer(certificate, plant), (torch.tensor(actions[:3]), torch.tensor(estimates[:3])))
