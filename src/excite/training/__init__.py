"""Training of policies and design of signals for a decision process."""
