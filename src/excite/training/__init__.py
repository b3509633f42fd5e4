"""Trainers: what turns a decision process into a policy."""
