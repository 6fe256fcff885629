"""Recording what gateways publish, as one of their subscribers."""
