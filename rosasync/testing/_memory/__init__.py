"""The middleware in memory behind `rosasync.testing.Graph`."""
