"""A running system seen from outside: figures for Prometheus, traces for OpenTelemetry."""
