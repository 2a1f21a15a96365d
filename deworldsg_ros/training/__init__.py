"""Training of probes: labelled clips, features extracted once, a fit, and its report."""
