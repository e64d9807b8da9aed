"""Mistakes that used to pass in silence: each is refused with a sentence, or heard."""

import copy

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.wrappers.vector import DictInfoToList

from agents import SB3VecEnv
from ncs_gym import Channel, Packet, RequestActions, VectorNetworked, VectorRequestActions, cart_pole, truck_trailer
from ncs_gym.network.channel import UnusedPacketsWarning
from tests.certificates import certificate_of
from tests.product import (
    linear_plant,
    loop_env,
    safe_loop,
    safety_shield,
    synthesize,
    vector_env,
    vector_shield,
)

PLANT, TWO = truck_trailer(mass=4000.0), np.zeros(2)


@pytest.fixture(scope="module")
def certificate():
    return certificate_of(PLANT)


@pytest.mark.filterwarnings("error")
def test_proposals_that_are_no_input_are_told_of_once_and_not_applied(certificate):
    gradient = torch.tensor([0.5], requires_grad=True)
    for proposed in (gradient, [gradient[0]], np.full((1, 1), 0.5), "full throttle", np.nan, np.array([np.inf])):
        loop = safe_loop(certificate, PLANT, Channel())
        loop.start([0.5, 0.0])
        assert loop.step(None).reason == "invalid"  # a controller that failed is no mistake
        with pytest.warns(UserWarning, match=r"one input, finite numbers of shape \(1,\), got .*K x_hat is applied"):
            decision = loop.step(proposed)
        assert decision.reason == "invalid"
        np.testing.assert_allclose(decision.input, certificate.K @ loop.estimate, atol=1e-6)
        loop.step(proposed)


@pytest.mark.parametrize("wrong", [torch.zeros(1, requires_grad=True), [torch.tensor(0.0, requires_grad=True)]])
def test_actions_with_a_gradient_are_refused(certificate, wrong):
    env, envs = loop_env(PLANT), vector_env(1, plant=PLANT)
    asks = Channel(on_request=True)
    asking, many = RequestActions(loop_env(PLANT, asks)), VectorRequestActions(vector_env(1, plant=PLANT, channel=asks))
    shields = safety_shield(loop_env(PLANT), certificate), vector_shield(vector_env(1, plant=PLANT), certificate)
    for each in (env, envs, asking, many, *shields):
        each.reset(seed=0)
        with pytest.raises(ValueError, match="must be finite with shape"):
            each.step(wrong)


def test_lists_of_infos_inside_are_refused_with_where_to_put_the_wrapper(certificate):
    inside = DictInfoToList(vector_env(2, plant=PLANT))
    asked = DictInfoToList(vector_env(2, plant=PLANT, channel=Channel(on_request=True)))
    classic = DictInfoToList(gym.make_vec("CartPole-v1", num_envs=2, vectorization_mode="sync"))
    around = {
        "VectorRequestActions": VectorRequestActions(asked),
        "VectorNetworked": VectorNetworked(classic),
        "SB3VecEnv": SB3VecEnv(inside),
    }
    for name, env in around.items():
        with pytest.raises(ValueError, match=rf"{name} reads .* makes a list .* outside of {name}"):
            env.reset()
    outside = DictInfoToList(vector_shield(vector_env(2, plant=PLANT), certificate))
    assert outside.reset()[1][1]["shield_guaranteed"]


@pytest.mark.parametrize("step", [0.2, 0.5, 9.0])
def test_rounding_too_coarse_for_any_update_is_named_once(step):
    with pytest.warns(
        UnusedPacketsWarning, match=f"no packet is of use: with this sensor noise, rounded to {step:g}, samples"
    ) as caught:
        env = gym.make("ncs_gym/TruckTrailer-v0", channel=Channel(quantization_step=step))
    assert len(caught) == 1
    env.reset(seed=0)
    assert [env.step(np.zeros(1))[4]["measurement_age"] for _ in range(50)] == [*range(1, 51)]


@pytest.mark.filterwarnings("error")
def test_channels_whose_packets_are_used_are_not_named():
    for step in (0.0, 0.05):
        loop_env(PLANT, Channel(quantization_step=step, delay=3))
        loop_env(cart_pole(full_state=False), Channel(loss=0.2, max_consecutive_losses=2))


def test_copy_of_a_loop_shares_nothing_with_it(certificate):
    """A shallow copy that shared the estimator would go on with what the other was told, and be guaranteed outside."""
    loop = safe_loop(certificate, PLANT, Channel(delay=1))
    loop.start([0.0, 0.0])
    x = np.zeros(2)
    for k in range(30):
        loop.receive([Packet(k, x, loop.episode)] if k else [])
        x = PLANT.A @ x + PLANT.B @ loop.decide([4.0]).input
    trial, own = copy.copy(loop), copy.deepcopy(loop)
    for _ in range(50):
        trial.receive()
        trial.decide([-4.0])
        loop.receive()
        own.receive()
        np.testing.assert_array_equal(loop.decide([4.0]).input, own.decide([4.0]).input)
        assert loop.guaranteed == own.guaranteed


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_bounds_of_zero_are_certified_without_a_word():
    none = dict.fromkeys(("disturbance_bound", "sensor_bound", "initial_bound"), 0.0)
    plant = linear_plant(A=[[1.0, 0.1], [-0.3, 0.85]], B=[[0.0], [0.1]], box=[1.0, 2.0], u_max=5.0, dt=0.1, **none)
    assert synthesize(plant).provenance["share_of_box"] > 0.7
