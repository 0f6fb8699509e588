"""What several test modules share: small scenes, formulas by hand, quick fits. No tests."""
