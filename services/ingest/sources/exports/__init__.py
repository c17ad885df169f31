"""What apps and programs for mapping export, each as its publisher writes it."""
