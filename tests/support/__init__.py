"""What tests share: servers, gateways, clients, networks, clocks, takes."""
