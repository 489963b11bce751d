# SPDX-License-Identifier: Apache-2.0
"""Time from inputs to command over DDS beside a bare rclpy relay, and the period's jitter beside a bare timer's."""

from __future__ import annotations

import sys

from campaigns.latency import main

if __name__ == "__main__":
    sys.exit(main())
