"""Make a bucket in the artifact store if it is not there yet; boto3 finds address and keys in the environment."""

import sys

import boto3

[bucket] = sys.argv[1:]
client = boto3.client("s3")
if bucket not in {found["Name"] for found in client.list_buckets()["Buckets"]}:
    client.create_bucket(Bucket=bucket)
print(f"bucket {bucket}: there")
