"""PPO-Lagrangian's price of a violation, and agents that add to a gain."""

from dataclasses import replace

import numpy as np
import pytest

from agents.agent import Agent
from agents.callbacks import DualAscentCallback
from agents.control_loop import ControlLoop
from agents.loop_wrappers import CostPenalty, ResidualActions
from agents.settings import LagrangianSettings, PPOSettings
from agents.sharing.agent_file import AgentError
from agents.training import train

CRUISE = ControlLoop(env="ncs_gym/TruckTrailerCruise-v0")
TINY = PPOSettings(envs=4, rollout=50, batch_size=200, epochs=1, width=8)
GAIN = np.array([[0.4, -0.3]])


def raised(settings, costs):
    """The multiplier after rollouts in which episodes with these costs ended."""
    priced = CostPenalty(CRUISE.vector(1), settings.multiplier)
    callback, multipliers = DualAscentCallback(settings, priced), []

    class Quiet:
        logger = type("Logger", (), {"record": lambda *entry: None})()

    callback.model = Quiet()
    for rollout in costs:
        for cost in rollout:
            callback.locals = {"dones": np.array([True, False]), "infos": [{"episode_violations": cost}, {}]}
            assert callback._on_step()
        callback._on_rollout_end()
        multipliers.append(priced.penalty)
    return multipliers


def test_multiplier_climbs_by_the_mean_cost_of_the_episodes_that_ended():
    settings = LagrangianSettings(learning_rate=0.1)
    assert raised(settings, [[4.0, 2.0], [], [10.0], [0.0]]) == pytest.approx([0.3, 0.3, 1.3, 1.3])


def test_multiplier_falls_below_the_limit_but_not_below_zero():
    settings = LagrangianSettings(learning_rate=0.5, cost_limit=3.0, multiplier=2.0)
    assert raised(settings, [[5.0], [1.0], [0.0], [0.0]]) == pytest.approx([3.0, 2.0, 0.5, 0.0])


@pytest.mark.parametrize("name", ["cost_limit", "learning_rate", "multiplier"])
@pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf")])
def test_settings_out_of_range_are_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} must be >= 0"):
        LagrangianSettings(**{name: value})


def test_training_raises_the_price_of_what_the_agent_violates(monkeypatch):
    prices, made = [], []
    original = DualAscentCallback._on_rollout_end

    def noted(self):
        original(self)
        prices.append(self._priced.penalty)
        made.append(self)

    monkeypatch.setattr(DualAscentCallback, "_on_rollout_end", noted)
    loop = ControlLoop(env=CRUISE.env, lagrangian=LagrangianSettings(learning_rate=0.5))
    result = train(loop, 1600, 0, settings=TINY)
    assert result.violation_steps > 0
    assert prices[:3] == [0.0, 0.0, 0.0]  # no episode has ended
    at_200 = next(point.violation_steps for point in result.history if point.steps == 800)
    assert prices[3] == pytest.approx(0.5 * at_200 / 4)
    assert prices[-1] == pytest.approx(0.5 * result.violation_steps / 4)
    plain = train(CRUISE, 1600, 0, settings=TINY)
    observations = np.random.default_rng(0).standard_normal((20, 3))
    assert (plain.agent.act(observations) != result.agent.act(observations)).any()


def test_residual_action_is_added_to_the_gain_and_clipped():
    inner = CRUISE.vector(3)
    envs = ResidualActions(inner, GAIN)
    observation, _ = envs.reset(seed=0)
    for part in (0.1, -0.2, 3.0):
        wanted = np.clip(observation[:, :2] @ GAIN.T + part, -1.0, 1.0)
        observation, *_, info = envs.step(np.full((3, 1), part))
        np.testing.assert_allclose(info["input"], inner.unwrapped.plant.u_max * wanted, rtol=1e-6)


def test_residual_agent_is_trained_saved_and_loaded_with_its_gain(tmp_path):
    loop = ControlLoop(env=CRUISE.env, residual_gain=GAIN)
    agent = train(loop, 400, 0, settings=TINY).agent
    observations = np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3)).astype(np.float32)
    part = agent.model.predict(agent.normalization(observations), deterministic=True)[0]
    np.testing.assert_allclose(agent.act(observations), np.clip(part + observations[:, :2] @ GAIN.T, -1, 1), rtol=1e-6)
    agent.save(tmp_path)
    np.testing.assert_array_equal(Agent.load(tmp_path).act(observations), agent.act(observations))
    wrong = replace(agent, residual_gain=np.ones((2, 2)))
    wrong.save(tmp_path)
    with pytest.raises(AgentError, match="residual gain"):
        Agent.load(tmp_path)
