"""The unit of work: a training run, the setup it takes place in, and the store of finished results."""

from experiments.runs.arms import Arm, by_arm
from experiments.runs.experiment_setup import ExperimentSetup
from experiments.runs.output_folder import claim_folder, require_place
from experiments.runs.provenance import versions
from experiments.runs.run_store import RunStore, prepare_output
from experiments.runs.training_run import RunResult, TrainingRun, execute_run

__all__ = [
    "Arm",
    "ExperimentSetup",
    "RunResult",
    "RunStore",
    "TrainingRun",
    "by_arm",
    "claim_folder",
    "execute_run",
    "prepare_output",
    "require_place",
    "versions",
]
