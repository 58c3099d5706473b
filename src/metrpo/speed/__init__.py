"""How fast it is: the same work done by metrpo and by other libraries."""
