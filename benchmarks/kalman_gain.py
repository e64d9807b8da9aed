"""Prints how often the gain taken by the estimator is the Kalman gain, in each registered environment.

The estimator tries the Kalman gain first and takes it only if the error stays in its certified set; otherwise it takes
the set-membership gain, or under a contract the certified gain of the estimate's age, or skips the sample
(docs/shield_proof.md). Counted is every update that it makes, those of replays included.
"""

from __future__ import annotations

import argparse
from collections import Counter

import gymnasium as gym
import numpy as np

from ncs_gym import Estimator, LinearPlant
from ncs_gym.envs.env import NCSEnv, ncs_env
from ncs_gym.estimation.arrival_histories import ArrivalHistories, histories_of
from ncs_gym.estimation.kalman_filter import ErrorRecursion, ErrorStatistics
from ncs_gym.registration import registered_ids

KINDS = ("Kalman", "set-membership", "certified", "skipped")


def count_gains(env: NCSEnv, histories: ArrivalHistories) -> Counter[str]:
    """Returns counts of which gain an estimator takes, of every update that it looks up in a graph from now on."""
    counts: Counter[str] = Counter()
    kinds: dict[int, str] = {}
    sensor = env.plant.kalman_covariances[1] + env.channel.quantization_step**2 / 12.0 * np.eye(env.plant.p)
    table, update = histories.table, histories.table.update

    def counted(number: int) -> tuple[np.ndarray, np.ndarray]:
        found = update(number)
        if number not in kinds:
            kinds[number] = kind_of(found[0], table.statistics(number), histories.recursion, sensor)
        counts[kinds[number]] += 1
        return found

    table.update = counted
    return counts


def kind_of(gain: np.ndarray, statistics: ErrorStatistics, recursion: ErrorRecursion, sensor: np.ndarray) -> str:
    """Returns which of the gains one is, by computing the others anew."""
    covariance, shape, age, _ = statistics
    if np.allclose(gain, kalman_gain(recursion.plant, covariance, sensor), rtol=1e-9, atol=1e-12):
        return "Kalman"
    if np.array_equal(gain, recursion.sets.gain(shape)):
        return "set-membership"
    ages = recursion.error_set.ages
    if ages is not None and 1 <= age <= len(ages.gains) and np.array_equal(gain, ages.gains[age - 1]):
        return "certified"
    assert not gain.any()
    return "skipped"


def kalman_gain(plant: LinearPlant, covariance: np.ndarray, sensor: np.ndarray) -> np.ndarray:
    """Returns P H' (H P H' + R)^-1, shape (n, p)."""
    innovation = plant.H @ covariance @ plant.H.T + sensor
    return np.linalg.solve(innovation, plant.H @ covariance).T


def gains_taken(env_id: str, episodes: int, seed: int = 0) -> Counter[str]:
    """Returns how often each kind of gain is taken in some episodes under random actions."""
    env = ncs_env(gym.make(env_id, terminate_on_violation=False))
    histories = histories_of(env.plant, env.channel, env.error_set)
    counts = count_gains(env, histories)
    env._estimator = Estimator(env.plant, env.channel, histories=histories)
    env.action_space.seed(seed)
    for episode in range(episodes):
        env.reset(seed=seed + episode)
        for _ in range(gym.spec(env_id).max_episode_steps or 200):
            env.step(env.action_space.sample())
    assert env.estimator._histories is histories  # no history was forgotten, with it the counts
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Prints how often the gain that the estimator takes is the Kalman gain."
    )
    parser.add_argument("--episodes", type=int, default=50)
    options = parser.parse_args()
    print(f"{'environment':26s}{'updates':>9s}" + "".join(f"{kind:>16s}" for kind in KINDS))
    for env_id in registered_ids():
        counts = gains_taken(env_id, options.episodes)
        total = sum(counts.values())
        fractions = "".join(f"{counts[kind] / total:16.2%}" for kind in KINDS)
        print(f"{env_id.removeprefix('ncs_gym/'):26s}{total:9,}{fractions}")


if __name__ == "__main__":
    main()
