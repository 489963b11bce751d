# SPDX-License-Identifier: Apache-2.0
"""Node `power_manager`: between the driver's demand and four motors. The node itself is in `power_manager_node`."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING

from iwm_power_manager.errors import IwmError
from iwm_power_manager.exit_codes import BAD_INPUT, DONE, FAILED
from iwm_power_manager.nodes import power_manager_config as config
from iwm_power_manager.ros.arguments import check_arguments, check_parameter_files
from iwm_power_manager.ros.interruption import Interruption
from iwm_power_manager.ros.transport import leave_shared_memory

if TYPE_CHECKING:
    from iwm_power_manager.nodes.power_manager_node import PowerManager

#: Not for `--help`.
NEEDS = ("iwm_power_manager.nodes.power_manager_node",)

_EXAMPLES = """\
  The car of the paper, its inputs on the package's own topics:
    power_manager
  Your car, its policies and its topics:
    power_manager --ros-args -p vehicle_file:=my_car.yaml -p policy_file:=my_policies -p signals_file:=my_signals.yaml
  Everything from one file, in a namespace:
    power_manager --ros-args --params-file config/nodes/power_manager.yaml -r __ns:=/car_1
"""


def main(args: list[str] | None = None) -> int:
    """Run the node until SIGINT or SIGTERM; one line if it cannot start."""
    # rclpy's own handlers would shut the context down before zero torque could be commanded.
    interruption = Interruption()
    interruption.install()
    try:
        check_parameter_files(sys.argv if args is None else args)
        check_arguments(
            "power_manager",
            "Splits the driver's power demand between four motors, until Ctrl-C.",
            config.SPECS,
            args,
            examples=_EXAMPLES,
        )
        return _run(interruption, args)
    except KeyboardInterrupt:
        return DONE  # ended before it had begun
    except IwmError as error:
        print(f"power_manager: {error}", file=sys.stderr)
        return error.exit_code


def _run(interruption: Interruption, args: list[str] | None) -> int:
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    from iwm_power_manager.nodes.pace import spin
    from iwm_power_manager.nodes.power_manager_node import PowerManager
    from iwm_power_manager.ros import ending

    node: PowerManager | None = None
    code = FAILED
    try:
        leave_shared_memory(os.environ)
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node = PowerManager()
        check_parameter_files(sys.argv if args is None else args, node.get_fully_qualified_name())
        interruption.started = True
        if node.get_parameter("autostart").value:
            node.start_when_prepared()
        spin(node, interruption)
        code = BAD_INPUT if node.start_failed and not interruption.requested else DONE
    except KeyboardInterrupt:
        code = DONE  # ended before it had begun
    except (IwmError, RuntimeError) as error:
        code = getattr(error, "exit_code", FAILED)
        print(f"power_manager: {str(error).splitlines()[0]}", file=sys.stderr)
    finally:
        compiling = node is not None and node.preparing
        with ending.bounded(code, ending.SHORT_S if compiling else None):
            if node is not None:
                node.stop()
                node.destroy_node()
                node = None
        if compiling:  # its thread would be waited for
            os._exit(code)
    return code


if __name__ == "__main__":
    from iwm_power_manager.ros import ending

    sys.exit(ending.at_exit(main()))
