"""Tables of methods: rows, jobs, the map over them, and what comes out."""
