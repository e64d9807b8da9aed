import subprocess
import sys
from pathlib import Path

import pytest

import agents

ROOT = Path(__file__).resolve().parents[2]


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'agents' has no attribute 'nothing'"):
        _ = agents.nothing


def test_results_and_settings_need_neither_stable_baselines3_nor_torch():
    code = """if True:
        import sys
        from agents import LoopConfig, Episode, Evaluation, ShieldSettings, TrainingPoint, evaluate
        from agents import tuned_hyperparams
        assert not {"stable_baselines3", "torch"} & sys.modules.keys()
    """
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
