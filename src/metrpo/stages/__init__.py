"""The stages of one outer iteration, each as the loop in `metrpo.algorithm` calls it."""
