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

#: What a transition is called that is asked for by its number.
_LABELS = {
    Transition.TRANSITION_CONFIGURE: "configure",
    Transition.TRANSITION_CLEANUP: "cleanup",
    Transition.TRANSITION_ACTIVATE: "activate",
    Transition.TRANSITION_DEACTIVATE: "deactivate",
    Transition.TRANSITION_UNCONFIGURED_SHUTDOWN: "shutdown",
    Transition.TRANSITION_INACTIVE_SHUTDOWN: "shutdown",
    Transition.TRANSITION_ACTIVE_SHUTDOWN: "shutdown",
}


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
            self.get_logger().warning(f"{_named(wanted)} is refused: {self._possible_in_words()}")
            response.success = False
            return response
        return self._change_state(request, response)

    def _possible(self) -> list[Transition]:
        return [Transition(id=found[0], label=found[1]) for found in self._state_machine.available_transitions]

    def _is_possible(self, wanted: Transition) -> bool:
        return any(wanted.label == found.label if wanted.label else wanted.id == found.id for found in self._possible())

    def _possible_in_words(self) -> str:
        found = ", ".join(map(_named, self._possible()))
        return f"the node is {self.lifecycle_state()}" + (f", from where it can {found}" if found else "")


def _named(transition: Transition) -> str:
    """Label and number of a transition, as far as they are known."""
    label = transition.label or _LABELS.get(transition.id, "transition")
    return f"{label} ({transition.id})" if transition.id else label
