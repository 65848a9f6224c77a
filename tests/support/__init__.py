"""What the tests share: servers in other processes, and waiting for conditions."""
