"""Which of the disturbances of `ncs attack` does the most harm to the arms of the study.

    python benchmarks/attacks_compared.py [--env ncs_gym/CSTR-v0 ...] [--arms lqr lqr+lookahead ...] [--episodes 200]

Sensor noise and first errors are of full size, and bursts of losses as long as the contract allows, each time. The
disturbance pushes to the nearest face of the box, as in the study's scenario "attacked", or out of the certified
polytope or ellipsoid, which `ncs attack` does as well. Printed are violating episodes in percent, on seeds that are not
the study's.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial

import numpy as np

from agents.loop import LoopConfig
from experiments.runs.experiment import run_of_arm
from experiments.runs.loops import under
from experiments.settings import CompareSettings
from experiments.settings.learning import NETWORK_ENVS
from experiments.terminal import text_table
from ncs_gym import AdversarialDisturbance
from ncs_gym.envs.env import ncs_env
from ncs_gym.uncertainty.disturbances import BY_NAME
from shields import certificate_for

ARMS = ("lqr", "governor:20", "mpc:20", "lqr+psf:20", "lqr+trusting:20", "lqr+shielded", "lqr+lookahead")
SEED = 3_000_000


def main() -> None:
    """Prints a table for every environment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="*", default=NETWORK_ENVS)
    parser.add_argument("--arms", nargs="*", default=ARMS)
    parser.add_argument("--episodes", type=int, default=200)
    options = parser.parse_args()
    for env_id in options.env:
        loop, settings = LoopConfig(env=env_id), CompareSettings(env=env_id, seed=SEED, episodes=options.episodes)
        env = ncs_env(loop.single())
        certificate = certificate_for(env.plant, env.certificate_contract)
        pushes = {
            "box": AdversarialDisturbance,
            "polytope": partial(AdversarialDisturbance, rows=certificate.polytope.rows),
            "ellipsoid": partial(AdversarialDisturbance, certificate.M),
        }
        BY_NAME.update(pushes)
        table = [[f"{env_id}, violating [%], pushed out of", *pushes]]
        for arm in options.arms:
            run = run_of_arm(settings, loop, certificate, arm, 0)
            attacked = under("attacked", run.loop)
            rates = []
            for push in pushes:
                result = replace(run, loop=attacked.with_kwargs(disturbance=push)).execute(lambda _: None)
                rates.append(100.0 * np.mean([each.violation_steps > 0 for each in result.episodes]))
            table.append([arm, *(f"{rate:.1f}" for rate in rates)])
        print(text_table(table), end="\n\n", flush=True)


if __name__ == "__main__":
    main()
