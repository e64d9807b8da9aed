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
    SweepSettings,
    TrainSettings,
)
from experiments.settings.settings_file import (
    INCIDENTAL_SETTINGS,
    config_defaults,
    lasting_settings,
    save_settings,
    settings_json,
)

__all__ = [
    "INCIDENTAL_SETTINGS",
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
    "SweepSettings",
    "SynthesizeSettings",
    "TrainSettings",
    "VerifySettings",
    "config_defaults",
    "lasting_settings",
    "save_settings",
    "settings_json",
]
