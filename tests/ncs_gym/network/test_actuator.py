"""The actuator's side of a downlink: what is no command is refused, and leaves the ones it holds."""

import numpy as np
import pytest

from ncs_gym import Actuator, Command

COMMAND = Command(stamp=0, inputs=np.array([[1.0], [2.0], [3.0]]))


def actuator_with_a_command():
    actuator = Actuator(input_delay=2, inputs=1)
    actuator.receive([COMMAND])
    return actuator


@pytest.mark.parametrize(
    ("commands", "words"),
    [
        (COMMAND, r"commands must be a list of Command\(stamp, inputs\), empty if nothing arrived, got Command"),
        (None, "commands must be a list of Command.* got None"),
        (5, "commands must be a list of Command.* got 5"),
        ([COMMAND._replace(stamp=1), None], r"a command is Command\(stamp, inputs\) .* got None"),
        ([COMMAND._replace(stamp=1.5)], r"with whole numbers and finite inputs of shape \(3, 1\)"),
        ([COMMAND._replace(stamp=1, episode="0")], "a command is"),
        ([COMMAND._replace(stamp=1, inputs=np.zeros((2, 1)))], "a command is"),
        ([COMMAND._replace(stamp=1, inputs=np.array([[1.0], [np.nan], [3.0]]))], "a command is"),
        ([(1,)], "a command is"),
    ],
)
def test_what_is_no_command_is_refused_before_anything_changes(commands, words):
    actuator = actuator_with_a_command()
    with pytest.raises(ValueError, match=words):
        actuator.receive(commands)
    np.testing.assert_array_equal(actuator.apply(2), [3.0])
    np.testing.assert_array_equal(actuator.apply(3), [0.0])
    assert actuator.missing


@pytest.mark.parametrize("step", [600.5, -1, None, True])
def test_a_step_is_counted(step):
    with pytest.raises(ValueError, match="step must be a whole number >= 0"):
        actuator_with_a_command().apply(step)


def test_an_episode_is_counted():
    with pytest.raises(ValueError, match="episode must be a whole number >= 0"):
        actuator_with_a_command().start(episode=0.5)


def test_plain_tuples_and_whole_numbers_of_numpy_are_commands():
    actuator = actuator_with_a_command()
    sent = np.array([[4.0], [5.0], [6.0]])
    actuator.receive(iter([(np.int64(1), sent)]))
    sent[:] = 9.0
    np.testing.assert_array_equal(actuator.apply(np.int64(3)), [6.0])
