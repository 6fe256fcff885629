"""What gateways publish now, decoded for programs that show it."""
