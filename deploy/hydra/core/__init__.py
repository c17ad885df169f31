"""What the bridge to Hydra knows and decides, without sockets or Spark-DSG (pure)."""
