"""How renders are compared with photographs: metrics, protocols, evaluation."""
