// SPDX-License-Identifier: Apache-2.0
using System;
using System.Collections.Generic;
using UnityEngine;

namespace Habitus
{
    /// <summary>
    /// Drives the pose blend shapes of a body that "habitus export --bake-correctives all" (or live:96) wrote, from how
    /// its bones are turned: skin bulges and creases under any animation, IK or hand-set pose. Put it on the
    /// SkinnedMeshRenderer, and the .correctives.json that lies beside the .fbx or .glb into its field.
    /// </summary>
    [ExecuteAlways]
    [DisallowMultipleComponent]
    [DefaultExecutionOrder(10000)] // after scripts that turn bones in LateUpdate
    [RequireComponent(typeof(SkinnedMeshRenderer))]
    [AddComponentMenu("habitus/Pose Correctives")]
    public sealed class PoseCorrectives : MonoBehaviour
    {
        [Tooltip("The .correctives.json that habitus export wrote beside the mesh.")]
        public TextAsset data;

        [Range(0, 1)]
        [Tooltip("1: as the body learned it.")]
        public float strength = 1;

        sealed class Driven
        {
            public Transform bone, parent;
            public Quaternion before, after;
            public readonly List<int> shapes = new List<int>();
            public readonly List<float> full = new List<float>();
            public readonly List<CorrectivesData.Channel> channels = new List<CorrectivesData.Channel>();
        }

        readonly float[] turned = new float[9];
        Driven[] driven;
        SkinnedMeshRenderer skin;
        BodyAxes axes;
        Transform[] bones;
        Matrix4x4[] rests;
        Mesh boundMesh;
        TextAsset boundData;

        /// <summary>Why nothing is driven; null where it is.</summary>
        public string Problem { get; private set; }

        void OnEnable()
        {
            boundMesh = null; // bones may have changed meanwhile
        }

        void LateUpdate()
        {
            Apply();
        }

        /// <summary>Bring the blend shapes to how the bones are turned now. LateUpdate does it in every frame.</summary>
        public void Apply()
        {
            if (skin == null)
                skin = GetComponent<SkinnedMeshRenderer>();
            if (boundMesh != skin.sharedMesh || boundData != data || driven == null)
                Bind();
            if (driven == null)
                return;
            foreach (var joint in driven)
            {
                var turn = joint.before * Quaternion.Inverse(joint.parent.rotation) * joint.bone.rotation * joint.after;
                LessIdentity(axes.ToBody(turn), turned);
                for (int k = 0; k < joint.shapes.Count; k++)
                {
                    var channel = joint.channels[k];
                    float weight = -channel.bias;
                    for (int e = 0; e < 9; e++)
                        weight += channel.row[e] * turned[e];
                    weight = Mathf.Pow(Mathf.Clamp01(weight), channel.power) * strength * joint.full[k];
                    skin.SetBlendShapeWeight(joint.shapes[k], weight);
                }
            }
        }

        void Bind()
        {
            boundMesh = skin.sharedMesh;
            boundData = data;
            driven = null;
            Problem = null;
            try
            {
                if (data == null || boundMesh == null)
                    throw new ArgumentException("needs a mesh and its .correctives.json");
                driven = Drive(CorrectivesData.Parse(data.text));
            }
            catch (ArgumentException error)
            {
                Problem = name + ": " + (data == null ? "" : data.name + " ") + error.Message;
                Debug.LogError(Problem, this);
            }
        }

        Driven[] Drive(CorrectivesData told)
        {
            bones = skin.bones; // copies, both
            rests = boundMesh.bindposes;
            var named = new Dictionary<string, int>();
            for (int k = 0; k < bones.Length; k++)
            {
                rests[k] = rests[k].inverse;
                if (bones[k] != null)
                    named[Plain(bones[k].name)] = k;
            }
            var parents = new Dictionary<string, string>();
            foreach (var joint in told.joints)
                parents[joint.name] = joint.parent;
            axes = FindAxes(told, named);
            var shapes = new Dictionary<string, int>();
            for (int k = 0; k < boundMesh.blendShapeCount; k++)
                shapes[Plain(boundMesh.GetBlendShapeName(k))] = k;
            var found = new Dictionary<string, Driven>();
            foreach (var channel in told.channels)
            {
                int shape;
                if (!shapes.TryGetValue(channel.name, out shape))
                    throw new ArgumentException(
                        "drives " + channel.name + ", which " + boundMesh.name + " has not: export both with the same "
                        + "--bake-correctives, and import blend shapes");
                Driven joint;
                if (!found.TryGetValue(channel.joint, out joint))
                    found[channel.joint] = joint = Between(named, channel.joint, parents[channel.joint]);
                joint.shapes.Add(shape);
                joint.full.Add(boundMesh.GetBlendShapeFrameWeight(shape, boundMesh.GetBlendShapeFrameCount(shape) - 1));
                joint.channels.Add(channel);
            }
            var all = new Driven[found.Count];
            found.Values.CopyTo(all, 0);
            return all;
        }

        Driven Between(Dictionary<string, int> named, string child, string parent)
        {
            foreach (var name in new[] { child, parent })
                if (!named.ContainsKey(name))
                    throw new ArgumentException(
                        "needs the bone " + name + ", which " + boundMesh.name + " has not: switch Optimize Game Objects off");
            int bone = named[child], above = named[parent];
            return new Driven
            {
                bone = bones[bone],
                parent = bones[above],
                before = rests[above].rotation,
                after = Quaternion.Inverse(rests[bone].rotation),
            };
        }

        BodyAxes FindAxes(CorrectivesData told, Dictionary<string, int> named)
        {
            var there = new List<Vector3>();
            var here = new List<Vector3>();
            foreach (var joint in told.joints)
            {
                int bone;
                if (!named.TryGetValue(joint.name, out bone))
                    continue;
                there.Add(rests[bone].GetColumn(3));
                here.Add(new Vector3(joint.rest[0], joint.rest[1], joint.rest[2]));
            }
            if (there.Count < 4)
                throw new ArgumentException("names joints of another skeleton than " + boundMesh.name + "'s");
            return BodyAxes.Find(there.ToArray(), here.ToArray());
        }

        /// <summary>A name without what importers and name spaces put before it.</summary>
        static string Plain(string name)
        {
            return name.Substring(name.LastIndexOfAny(new[] { '.', ':', '|' }) + 1);
        }

        /// <summary>vec(R - I), rows first, of a unit quaternion.</summary>
        static void LessIdentity(Quaternion q, float[] entries)
        {
            entries[0] = -2 * (q.y * q.y + q.z * q.z);
            entries[1] = 2 * (q.x * q.y - q.w * q.z);
            entries[2] = 2 * (q.x * q.z + q.w * q.y);
            entries[3] = 2 * (q.x * q.y + q.w * q.z);
            entries[4] = -2 * (q.x * q.x + q.z * q.z);
            entries[5] = 2 * (q.y * q.z - q.w * q.x);
            entries[6] = 2 * (q.x * q.z - q.w * q.y);
            entries[7] = 2 * (q.y * q.z + q.w * q.x);
            entries[8] = -2 * (q.x * q.x + q.y * q.y);
        }
    }
}
