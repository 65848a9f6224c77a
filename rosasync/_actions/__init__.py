"""Everything between an action and the ports: goals of a client, and servers."""
