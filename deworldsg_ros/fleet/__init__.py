"""Several robots: their graphs become one over Zenoh, whatever their world frames are."""
