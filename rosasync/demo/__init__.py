"""The demo: rosasync beside threaded ``client.call``, on a stock server in another process."""
