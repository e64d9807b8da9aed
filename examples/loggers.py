"""Sends what a training logs to TensorBoard, Weights & Biases and MLflow, by the hooks of stable-baselines3 and wandb.

W&B and MLflow are left out where they are not installed. All three leave files in the folder `logs` and need neither
account nor network: `tensorboard --logdir logs/tensorboard`, `wandb sync logs/wandb/offline-run-*`,
`mlflow ui --backend-store-uri sqlite:///logs/mlflow.db`.

Takes about 30 seconds on one core.
"""

import argparse
from importlib.util import find_spec
from pathlib import Path

import gymnasium as gym
from stable_baselines3 import PPO
from stable_baselines3.common.logger import KVWriter, configure
from stable_baselines3.common.monitor import Monitor
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from agents import SafetyCallback
from shields import SafetyShield

parser = argparse.ArgumentParser()
parser.add_argument("--steps", type=int, default=4096)
options = parser.parse_args()
logs = Path("logs").absolute()
logs.mkdir(exist_ok=True)
METRICS = ("safety/violation_rate", "safety/intervention_rate")
# `SafetyCallback` logs them after every rollout, beside stable-baselines3's own.
callbacks, writers = [SafetyCallback()], []

if find_spec("wandb"):
    import wandb
    from wandb.integration.sb3 import WandbCallback

    # Copies what TensorBoard gets, from the moment on that it begins: before the logger is made.
    tracked = wandb.init(project="ncs-gym", mode="offline", sync_tensorboard=True, dir=logs)
    callbacks.append(WandbCallback())

if find_spec("mlflow"):
    import mlflow

    class MLflowWriter(KVWriter):
        """Logs the numbers of stable-baselines3's logger."""

        def write(self, key_values, key_excluded, step=0):
            """Logs what is a number and not excluded from this output."""
            left_out = {name for name, outputs in key_excluded.items() if "mlflow" in (outputs or ())}
            numbers = {name: value for name, value in key_values.items() if isinstance(value, int | float)}
            mlflow.log_metrics({name: value for name, value in numbers.items() if name not in left_out}, step=step)

        def close(self):
            """Ends the run."""
            mlflow.end_run()

    mlflow.set_tracking_uri(f"sqlite:///{logs}/mlflow.db")
    mlflow.set_experiment("ncs-gym")
    run_id = mlflow.start_run().info.run_id
    writers.append(MLflowWriter())

env = Monitor(SafetyShield(gym.make("ncs_gym:ncs_gym/TruckTrailerCruise-v0")))
model = PPO("MlpPolicy", env, n_steps=512, seed=0, device="cpu")
logger = configure(str(logs / "tensorboard"), ["tensorboard"])
logger.output_formats += writers
model.set_logger(logger)
model.learn(options.steps, callback=callbacks)
logger.close()

events = EventAccumulator(str(logs / "tensorboard")).Reload()
print("TensorBoard:", *(f"{name} {events.Scalars(name)[-1].value:.3f}" for name in METRICS))
if find_spec("wandb"):
    folder = Path(tracked.dir).parent
    wandb.finish()  # which prints what it has of each metric
    print("W&B:", folder.relative_to(logs.parent))
if find_spec("mlflow"):
    logged = mlflow.get_run(run_id).data.metrics
    print("MLflow:", *(f"{name} {logged[name]:.3f}" for name in METRICS))
