"""The client side: a test module for each module of `rosasync._client`."""
