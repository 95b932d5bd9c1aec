"""Live sources of samples (MQTT, OPC UA, Modbus), and outlets for events (MQTT, Prometheus).

A source delivers values of tags with the times at which they were measured; `row_buffer` sorts them into rows. Each
outside library is imported by one module, when that module is used.
"""
