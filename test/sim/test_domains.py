# SPDX-License-Identifier: Apache-2.0
"""No two runs get the same DDS domain."""

from __future__ import annotations

from contextlib import ExitStack

import pytest

from iwm_power_manager.errors import IwmError
from iwm_sim import domains
from iwm_sim.domains import claimed_domain


def test_runs_at_the_same_time_get_different_domains() -> None:
    with ExitStack() as stack:
        found = [stack.enter_context(claimed_domain()) for _ in range(10)]
    assert len(set(found)) == 10
    assert set(found) <= set(domains.DOMAINS)


def test_a_domain_is_free_again_and_when_none_is_the_run_is_refused(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(domains.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(domains, "DOMAINS", range(7, 8))
    for _ in range(2):
        with claimed_domain() as domain:
            assert domain == 7
            with pytest.raises(IwmError, match="in use"), claimed_domain():
                pass
