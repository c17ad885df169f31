"""What every service process shares: bus, host loop, config, logs, record and replay."""
