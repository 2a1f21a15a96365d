"""Where camera poses come from when a recording's own are missing, replaced or made worse."""
