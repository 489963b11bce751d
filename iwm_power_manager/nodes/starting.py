# SPDX-License-Identifier: Apache-2.0
"""A managed node on its way to active: it prepares in a thread, and its services are answered meanwhile."""

from __future__ import annotations

from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.task import Future

from iwm_power_manager.nodes import power_manager_config as config
from iwm_power_manager.nodes.preparation import Preparation, Prepared
from iwm_power_manager.ros.parameters import KeepsItsValues


class Starting(KeepsItsValues, LifecycleNode):
    """The part of the power manager that gets it to active.

    Attributes
    ----------
    start_failed : it was to start by itself, and that was refused
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._preparation: Preparation | None = None
        self._prepared: Future | None = None
        self._starting = False
        self.start_failed = False
        # rclpy ends a transition that the present state does not have in an exception; its client would wait forever.
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._change_state_if_possible
        # It waits for what is prepared; in the node's own group everything else would wait with it.
        self._service_change_state.callback_group = MutuallyExclusiveCallbackGroup()
        self._service_change_state.callback_group.add_entity(self._service_change_state)

    def lifecycle_state(self) -> str:
        """Label of the present state."""
        return str(self._state_machine.current_state[1])

    def start(self) -> bool:
        """Configure and activate, and wait for it; False if that was refused."""
        return (
            self.trigger_configure() == TransitionCallbackReturn.SUCCESS
            and self.trigger_activate() == TransitionCallbackReturn.SUCCESS
        )

    def start_when_prepared(self) -> None:
        """Begin to prepare; the executor then configures and activates. `start_failed` if that is refused."""
        self._starting = True
        self._prepare()

    def go_on_starting(self) -> None:
        """The next step on the way to active, once it is possible; to be called again and again."""
        if self._starting and not self.preparing:
            self._starting = False
            self.start_failed = not self.start()

    @property
    def preparing(self) -> bool:
        """A thread is loading and compiling."""
        return self._preparation is not None and self._preparation.running

    @property
    def preparing_s(self) -> float | None:
        """How long it has been preparing, or took until now; None before and after."""
        return None if self._preparation is None else self._preparation.elapsed_s

    def present_values(self) -> dict[str, Any]:
        """Values of all parameters."""
        return {name: self.get_parameter(name).value for name in config.BY_NAME}

    def _prepare(self) -> Future:
        """Begin to prepare, unless that is going on; what is returned is done when it is over."""
        if self._prepared is None:
            done = self._prepared = Future(executor=self.executor)
            self._preparation = Preparation(self.present_values(), lambda: done.set_result(None))
        return self._prepared

    def take_preparation(self, values: dict[str, Any]) -> Prepared:
        """What was prepared of these parameters, or is now.

        Raises
        ------
        IwmError
            Something stands against it.
        """
        preparation, self._preparation, self._prepared = self._preparation, None, None
        if preparation is None or preparation.values != values:
            preparation = Preparation(values, lambda: None)
        return preparation.result()

    async def _change_state_if_possible(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        wanted = request.transition
        configure = wanted.label == "configure" if wanted.label else wanted.id == Transition.TRANSITION_CONFIGURE
        if configure and self._is_possible(wanted):
            await self._prepare()  # other services are answered meanwhile
        if not self._is_possible(wanted):
            name = wanted.label or wanted.id
            self.get_logger().warning(f"there is no transition {name} from state {self.lifecycle_state()}")
            response.success = False
            return response
        return self._change_state(request, response)

    def _is_possible(self, wanted: Transition) -> bool:
        possible = {(found[0], found[1]) for found in self._state_machine.available_transitions}
        return any(wanted.label == label if wanted.label else wanted.id == number for number, label in possible)
