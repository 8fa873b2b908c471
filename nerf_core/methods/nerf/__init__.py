"""The paper's NeRF: stratified, then importance sampling."""
