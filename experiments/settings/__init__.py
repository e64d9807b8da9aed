"""What each command can be told: frozen dataclasses that the parser turns into flags, and the file that keeps them."""

from experiments.settings.backend import EngineSettings
from experiments.settings.certificates import (
    AuditSettings,
    CertifySettings,
    ReproduceSettings,
    SynthesizeSettings,
    VerifySettings,
)
from experiments.settings.channel import ChannelSettings
from experiments.settings.learning import (
    CompareSettings,
    EvaluateSettings,
    LearningSettings,
    RenderSettings,
    SweepSettings,
    TrainSettings,
)

__all__ = [
    "AuditSettings",
    "CertifySettings",
    "ChannelSettings",
    "CompareSettings",
    "EngineSettings",
    "EvaluateSettings",
    "LearningSettings",
    "RenderSettings",
    "ReproduceSettings",
    "SweepSettings",
    "SynthesizeSettings",
    "TrainSettings",
    "VerifySettings",
]
