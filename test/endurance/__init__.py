"""Long runs and crashes: `scripts/soak`, `scripts/crash`, and the tests that run a part of them."""
