"""The demo: rosasync compared with threaded ``client.call``, against a stock server."""
