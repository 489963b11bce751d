"""Plant, driver and simulator node for iwm_power_manager."""
