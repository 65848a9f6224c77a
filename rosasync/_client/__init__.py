"""Everything between a call and the port that sends it."""
