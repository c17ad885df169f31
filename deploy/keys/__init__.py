"""Certificates of those who take part, and what each may do."""
