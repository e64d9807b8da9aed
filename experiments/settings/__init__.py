"""What each command can be told: frozen dataclasses that the parser turns into flags, and the file that keeps them."""

from experiments.settings.arguments import Assignments
from experiments.settings.certificates import (
    AttackSettings,
    AuditSettings,
    ChannelSettings,
    LoopSettings,
    RenderSettings,
    ReproduceSettings,
    RequirementsSettings,
    SynthesizeSettings,
    VerifySettings,
)
from experiments.settings.learning import (
    BackendSettings,
    CompareSettings,
    EvaluateSettings,
    LearningSettings,
    StudySettings,
    SweepSettings,
    TrainSettings,
)
from experiments.settings.settings_file import config_defaults, save_settings, settings_json

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
