"""Doors to a running system for programs that do not speak its bus: HTTP, and tools of planners (MCP)."""
