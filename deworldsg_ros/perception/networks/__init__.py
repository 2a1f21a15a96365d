"""What the networks of several backends share."""
