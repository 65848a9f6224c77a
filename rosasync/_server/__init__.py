"""Everything between a request that was taken and its response."""
