"""What the tests share: servers in other processes, domains, waiting without sleeping."""
