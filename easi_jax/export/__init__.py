"""Results for others: policies as ONNX and StableHLO, parameters as MJCF and ranges."""
