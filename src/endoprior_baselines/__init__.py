"""The methods that can be trained, a file each; `core.methods` names them."""
