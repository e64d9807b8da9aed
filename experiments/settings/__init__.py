"""What each command can be told: frozen dataclasses that the parser turns into flags, and their JSON values."""

from experiments.settings.arguments import Assignments
from experiments.settings.certificates import (
    AttackSettings,
    AuditSettings,
    BoundsSettings,
    ChannelSettings,
    ExportCSettings,
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
    SweepSettings,
    TrainSettings,
)
from experiments.settings.settings_file import lasting_settings

__all__ = [
    "Assignments",
    "AttackSettings",
    "AuditSettings",
    "BackendSettings",
    "BoundsSettings",
    "ChannelSettings",
    "CompareSettings",
    "EvaluateSettings",
    "ExportCSettings",
    "LearningSettings",
    "RenderSettings",
    "ReproduceSettings",
    "RequirementsSettings",
    "SweepSettings",
    "SynthesizeSettings",
    "TrainSettings",
    "VerifySettings",
    "lasting_settings",
]
