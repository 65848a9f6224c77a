"""What a server knows of a call, for its caller, and the other way round."""
