# SPDX-License-Identifier: Apache-2.0
"""An executor served in a thread of its own, which has ended before anything that it waits for is destroyed."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from rclpy.executors import Executor, InvalidHandle


@contextmanager
def in_thread(executor: Executor, name: str) -> Iterator[None]:
    """Serve an executor's nodes while the body of the `with` runs; afterwards the executor is shut down.

    `Executor.shutdown` waits for nobody: called while another thread is in `spin`, it takes away what that one is about
    to wait for. So the thread is woken by a task, and ends by itself.
    """
    over = threading.Event()

    def serve() -> None:
        while not over.is_set():
            with suppress(InvalidHandle):  # an entity was destroyed between being found ready and being served
                executor.spin_once()

    thread = threading.Thread(target=serve, name=name, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        executor.create_task(over.is_set)
        thread.join()
        executor.shutdown()
