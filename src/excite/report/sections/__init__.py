"""What a report says of one run: an experiment, a record, or a study."""
