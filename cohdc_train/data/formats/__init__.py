"""Read annotation formats of other tools."""
