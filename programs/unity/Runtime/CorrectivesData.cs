// SPDX-License-Identifier: Apache-2.0
using System;
using UnityEngine;

namespace Habitus
{
    /// <summary>What "walk.correctives.json" says: how bones drive the blend shapes of "walk.fbx".</summary>
    [Serializable]
    public sealed class CorrectivesData
    {
        public const string Format = "habitus-correctives";
        public const int Linear = 1, Folds = 2; // editions, the second with bias and power

        public string format;
        public int version;
        public string body;
        public Joint[] joints;
        public Channel[] channels;

        /// <summary>A joint, its parent ("" for the root), and where it rests: metres, x to the body's left, y up, z forward.</summary>
        [Serializable]
        public sealed class Joint
        {
            public string name;
            public string parent;
            public float[] rest;
        }

        /// <summary>
        /// A blend shape; its weight is row . vec(R - I) - bias, R how its joint is turned, cut off between 0 and 1, to the
        /// power. Edition 1 has neither: 0 and 1.
        /// </summary>
        [Serializable]
        public sealed class Channel
        {
            public string name;
            public string joint;
            public float[] row;
            public float bias;
            public float power;
        }

        /// <summary>Read the text of such a file.</summary>
        /// <exception cref="ArgumentException">It is none, or of an edition that this package does not know.</exception>
        public static CorrectivesData Parse(string text)
        {
            var data = JsonUtility.FromJson<CorrectivesData>(text);
            if (data == null || data.format != Format || data.joints == null || data.channels == null)
                throw new ArgumentException("is no .correctives.json of habitus export");
            if (data.version != Linear && data.version != Folds)
                throw new ArgumentException("is of edition " + data.version + "; this package reads editions 1 and 2");
            foreach (var joint in data.joints)
                if (joint.rest == null || joint.rest.Length != 3)
                    throw new ArgumentException("does not say where " + joint.name + " rests");
            foreach (var channel in data.channels)
            {
                if (channel.row == null || channel.row.Length != 9)
                    throw new ArgumentException("has no row of nine numbers for " + channel.name);
                if (data.version == Linear)
                {
                    channel.bias = 0;
                    channel.power = 1;
                }
                if (!(channel.power > 0))
                    throw new ArgumentException("has no positive power for " + channel.name);
            }
            return data;
        }
    }
}
