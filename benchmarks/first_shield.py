"""Processor time until the first shield of each registered environment is made, each in a process of its own.

    python benchmarks/first_shield.py [ID ...]

Imports are not counted: benchmarks/import_time.py has them.
"""

from __future__ import annotations

import subprocess
import sys

from ncs_gym.registration import registered_ids

_SOURCE = """
import sys, time
import gymnasium as gym, ncs_gym
from shields import SafetyShield, VectorSafetyShield
times = [time.process_time()]
SafetyShield(gym.make(sys.argv[1]))
times.append(time.process_time())
env = VectorSafetyShield(gym.make_vec(sys.argv[1], num_envs=1024))
env.reset(seed=0)
times.append(time.process_time())
env.step(env.action_space.sample())
times.append(time.process_time())
print(*(f"{1e3 * (later - earlier):12.0f}" for earlier, later in zip(times, times[1:])))
"""


def main() -> None:
    print(f"{'processor time [ms]':32s}{'shield':>12s} {'1024, reset':>12s} {'first step':>12s}")
    for env_id in sys.argv[1:] or registered_ids():
        run = subprocess.run([sys.executable, "-c", _SOURCE, env_id], capture_output=True, text=True, check=True)
        print(f"{env_id:32s}{run.stdout}", end="", flush=True)


if __name__ == "__main__":
    main()
