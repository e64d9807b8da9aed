"""What each command can be told: frozen dataclasses that the parser turns into flags, and the file that keeps them."""

from experiments.settings.assignments import Assignments
from experiments.settings.backend import BackendSettings
from experiments.settings.certificates import (
    AttackSettings,
    AuditSettings,
    ChannelSettings,
    ReproduceSettings,
    RequirementsSettings,
    SynthesizeSettings,
    VerifySettings,
)
from experiments.settings.learning import (
    CompareSettings,
    EvaluateSettings,
    LearningSettings,
    TrainSettings,
)
from experiments.settings.network_loop import LoopSettings
from experiments.settings.rendering import RenderSettings
from experiments.settings.settings_file import config_defaults, save_settings, settings_json
from experiments.settings.study import StudySettings, SweepSettings

__all__ = [
    "Assignments",
    "AttackSettings",
    "AuditSettings",
    "BackendSettings",
    "ChannelSettings",
    "CompareSettings",
    "EvaluateSettings",
    "LearningSettings",
    "LoopSettings",
    "RenderSettings",
    "ReproduceSettings",
    "RequirementsSettings",
    "StudySettings",
    "SweepSettings",
    "SynthesizeSettings",
    "TrainSettings",
    "VerifySettings",
    "config_defaults",
    "save_settings",
    "settings_json",
]
