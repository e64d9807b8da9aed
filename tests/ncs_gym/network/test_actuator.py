"""The actuator's side of a downlink: what is no command is refused, and leaves the ones it holds."""

import numpy as np

from ncs_gym import Actuator, Command

COMMAND = Command(stamp=0, inputs=np.array([[1.0], [2.0], [3.0]]))


def actuator_with_a_command():
    actuator = Actuator(input_delay=2, inputs=1)
    actuator.receive([COMMAND])
    return actuator


def test_plain_tuples_and_whole_numbers_of_numpy_are_commands():
    actuator = actuator_with_a_command()
    sent = np.array([[4.0], [5.0], [6.0]])
    actuator.receive(iter([(np.int64(1), sent)]))
    sent[:] = 9.0
    np.testing.assert_array_equal(actuator.apply(np.int64(3)), [6.0])
