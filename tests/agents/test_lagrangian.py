"""PPO-Lagrangian's price of a violation."""

import pytest

from agents.callbacks import DualAscentCallback
from agents.loop import CostPenalty, LagrangianSettings, LoopConfig
from agents.training import train

CRUISE = LoopConfig(env="ncs_gym/TruckTrailerCruise-v0")
TINY = dict(n_envs=4, n_steps=50, batch_size=200, n_epochs=1, policy_kwargs=dict(net_arch=[8, 8]))


def raised(settings, rollouts, env_id):
    """The multiplier after rollouts, each given by its number of steps in two environments and its violating steps."""
    loop = LoopConfig(env=env_id, lagrangian=settings)
    priced = loop.vector(2)
    assert isinstance(priced, CostPenalty)
    callback, multipliers = DualAscentCallback(settings, priced, loop.episode_steps), []

    class Quiet:
        logger, num_timesteps = type("Logger", (), {"record": lambda *entry: None})(), 0

        def get_env(self):
            return priced  # no SB3VecEnv: infos are dictionaries

    callback.model = Quiet()
    for steps, violating in rollouts:
        for step in range(steps):
            callback.locals = {"infos": [{"cost": float(step < violating)}, {"cost": 0.0}]}
            assert callback.on_step()
        callback.on_rollout_end()
        multipliers.append(priced.penalty)
    return multipliers


CLIMBING = {"learning_rate": 0.1}


@pytest.mark.parametrize(
    ("settings", "rollouts", "env_id", "expected"),
    [
        # 200 steps in an episode: 3 of 200, 0 of 100 (too few), 5 of 200 together, 0 of 400 steps violate.
        (CLIMBING, [(100, 3), (50, 0), (50, 5), (200, 0)], CRUISE.env, [0.3, 0.3, 0.8, 0.8]),
        # Episodes that a violation ends are not cheap.
        (CLIMBING, [(200, 4)], "ncs_gym/BatchReactor-v0", [0.1 * 4 * 200 / 400]),
        # It falls below the limit, but not below zero.
        (
            {"learning_rate": 0.5, "cost_limit": 3.0, "multiplier": 2.0},
            [(100, 5), (100, 1), (100, 0), (100, 0)],
            CRUISE.env,
            [3.0, 2.0, 0.5, 0.0],
        ),
    ],
)
def test_multiplier_climbs_by_the_cost_of_a_full_episode_at_the_rate_of_the_rollout(
    settings, rollouts, env_id, expected
):
    assert raised(LagrangianSettings(**settings), rollouts, env_id) == pytest.approx(expected)


def test_an_episode_is_as_long_as_the_environment_says():
    settings = LagrangianSettings(cost_limit=2.0, multiplier=1.0)
    loop = LoopConfig(env=CRUISE.env, kwargs={"max_episode_steps": 40}, lagrangian=settings)
    history = train(loop, 400, 0, hyperparams=TINY).history
    price, before = settings.multiplier, 0
    for point in history:
        cost = (point.violation_steps - before) / 200 * 40
        price, before = max(0.0, price + settings.learning_rate * (cost - 2.0)), point.violation_steps
        assert point.multiplier == pytest.approx(price)
    assert len(history) == 2
    with pytest.raises(ValueError, match="has no max_episode_steps"):
        LoopConfig(env=CRUISE.env, kwargs={"max_episode_steps": -1}, lagrangian=settings)
