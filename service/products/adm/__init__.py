"""Attitude Data Messages of CCSDS 504.0-B-2: AEM, APM and ACM, as KVN and XML."""
