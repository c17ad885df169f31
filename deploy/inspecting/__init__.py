"""Looking at logs, places and topics."""
