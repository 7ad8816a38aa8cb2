"""What the twin can press on."""
