# SPDX-License-Identifier: Apache-2.0
"""Plant, driver and simulator node for iwm_power_manager."""
