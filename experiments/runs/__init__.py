"""The unit of work: a training run, the control loop it takes place in, and the store of finished results."""

from experiments.runs.arms import Arm, by_arm
from experiments.runs.experiment import (
    certificate_of,
    experiment_provenance,
    require_trainable,
    run_of_arm,
)
from experiments.runs.going_on import forget_checkpoint, going_on
from experiments.runs.loops import loop_config
from experiments.runs.output_folder import claim_folder, prepare_output, require_place, write_results
from experiments.runs.provenance import versions
from experiments.runs.run_store import RunStore
from experiments.runs.training_run import RunResult, TrainingRun

__all__ = [
    "Arm",
    "RunResult",
    "RunStore",
    "TrainingRun",
    "by_arm",
    "certificate_of",
    "claim_folder",
    "experiment_provenance",
    "forget_checkpoint",
    "going_on",
    "loop_config",
    "prepare_output",
    "require_place",
    "require_trainable",
    "run_of_arm",
    "versions",
    "write_results",
]
