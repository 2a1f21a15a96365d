"""Tables that compare methods: rows, jobs, parallel runs, results."""
