# SPDX-License-Identifier: Apache-2.0
"""The control law: pure functions of numbers, no ROS, no files, no clock."""
