"""Agents behind a network, with and without knowing how old what they see is: three environments of Gymnasium.

    python examples/delayed_classics.py [--seeds 3] [--smoke] [--out delayed_classics.png]

Takes about 4500 seconds on one core (with --smoke 40). PPO of stable-baselines3 (and SAC, where actions are
continuous) is trained and evaluated on no network, on one that delays observations by two steps, and on one that
loses half of them in bursts, with and without the age of the newest observation and the pending actions beside it.
Hyperparameters are those of rl-baselines3-zoo, but that all observations are normalized (ages and actions have other
scales), rates are constant, and Acrobot and SAC train for less. Prints the mean return with Student's 95 % interval
over the trainings, and draws it if matplotlib is installed.
"""

import argparse

import numpy as np
import torch
from scipy import stats
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

from ncs_gym import Channel, GilbertElliott, Networked

NETWORKS = {
    "no network": Channel(),
    "delay 2": Channel(delay=2),
    "bursts": Channel(loss=GilbertElliott(p_good_to_bad=0.25, p_bad_to_good=0.25)),
}
KNOWING = ("age", "pending_actions")
PENDING = 4
# Steps of a training, environments side by side, and the algorithm with what it does not have by default.
TRAININGS = {
    ("CartPole-v1", "PPO"): (
        100_000,
        8,
        PPO,
        {"n_steps": 32, "batch_size": 256, "gae_lambda": 0.8, "gamma": 0.98, "n_epochs": 20, "learning_rate": 1e-3},
    ),
    ("Acrobot-v1", "PPO"): (100_000, 16, PPO, {"n_steps": 256, "gae_lambda": 0.94, "n_epochs": 4}),
    ("Pendulum-v1", "PPO"): (
        100_000,
        4,
        PPO,
        {"n_steps": 1024, "gamma": 0.9, "learning_rate": 1e-3, "use_sde": True, "sde_sample_freq": 4},
    ),
    ("Pendulum-v1", "SAC"): (8_000, 1, SAC, {"learning_rate": 1e-3}),
}
EPISODES = 20


def mean_return(env_id, training, channel, observe, seed, smoke):
    """Trains one agent and returns its mean return over episodes on the same network."""
    steps, count, algorithm, settings = training
    settings = settings | ({"learning_starts": 100} if smoke and algorithm is SAC else {})

    def envs(count, seed):
        network = {"channel": channel, "observe": observe} | ({"pending": PENDING} if observe else {})
        return make_vec_env(env_id, count, seed=seed, wrapper_class=Networked, wrapper_kwargs=network)

    normalized = VecNormalize(envs(count, seed), norm_reward=algorithm is PPO and env_id == "Acrobot-v1")
    model = algorithm("MlpPolicy", normalized, seed=seed, device="cpu", **settings)
    model.learn(256 if smoke else steps)
    fresh = VecNormalize(envs(1, 1000 + seed), training=False, norm_reward=False)
    fresh.obs_rms = normalized.obs_rms
    return evaluate_policy(model, fresh, 2 if smoke else EPISODES, warn=False)[0]


def interval(returns):
    """Returns the mean and the half-width of Student's 95 % interval."""
    half = stats.sem(returns) * stats.t.ppf(0.975, len(returns) - 1) if len(returns) > 1 else np.nan
    return np.mean(returns), half


def draw(found, out):
    """Draws a panel per training."""
    import matplotlib.pyplot as plt

    panels = list(dict.fromkeys(key[:2] for key in found))
    figure, axes = plt.subplots(1, len(panels), figsize=(3.2 * len(panels), 3.2), layout="constrained")
    for axis, panel in zip(np.atleast_1d(axes), panels, strict=True):
        for shift, known, color in ((-0.1, False, "tab:orange"), (0.1, True, "tab:blue")):
            rows = [
                (k, *found[*panel, name, known]) for k, name in enumerate(NETWORKS) if (*panel, name, known) in found
            ]
            at, means, halves = np.array(rows).T
            label = "also sees age and pending actions" if known else "sees what arrived"
            axis.errorbar(at + shift, means, halves, fmt="o", color=color, capsize=3, label=label)
        axis.set_xticks(range(len(NETWORKS)), NETWORKS)
        axis.set_title(f"{panel[0]}, {panel[1]}", fontsize=10)
        axis.set_xlim(-0.5, len(NETWORKS) - 0.5)
    np.atleast_1d(axes)[0].set_ylabel("mean return")
    figure.legend(
        *np.atleast_1d(axes)[0].get_legend_handles_labels(), loc="outside upper center", ncols=2, frameon=False
    )
    figure.savefig(out, dpi=150)


def main():
    """Trains, prints and draws."""
    torch.set_num_threads(1)  # more wait for one another with networks this small
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--smoke", action="store_true", help="a few steps of each: shows that it runs")
    parser.add_argument("--only", nargs="*", help="ids of environments, also with an algorithm: Pendulum-v1/SAC")
    parser.add_argument("--out", help="file of the figure")
    options = parser.parse_args()
    found = {}
    print(f"{'mean return':18s}{'network':12s}{'sees what arrived':>20s}{'and age, actions':>20s}")
    for (env_id, name), training in TRAININGS.items():
        if options.only and not {env_id, f"{env_id}/{name}"} & set(options.only):
            continue
        for network, channel in NETWORKS.items():
            texts = []
            for observe in ((), KNOWING):
                if network == "no network" and observe:
                    continue
                seeds = range(1 if options.smoke else options.seeds)
                returns = [mean_return(env_id, training, channel, observe, seed, options.smoke) for seed in seeds]
                found[env_id, name, network, bool(observe)] = interval(returns)
                mean, half = found[env_id, name, network, bool(observe)]
                texts.append(f"{mean:.1f}" if np.isnan(half) else f"{mean:.1f} +- {half:.1f}")
            print(
                f"{env_id.removesuffix('-v1'):12s}{name:6s}{network:12s}" + "".join(f"{text:>20s}" for text in texts),
                flush=True,
            )
    if options.out:
        draw(found, options.out)


if __name__ == "__main__":
    main()
