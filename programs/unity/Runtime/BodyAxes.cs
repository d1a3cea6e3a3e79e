// SPDX-License-Identifier: Apache-2.0
using System;
using UnityEngine;

namespace Habitus
{
    /// <summary>
    /// Which axes of a mesh are the body's (x to its left, y up, z forward). Importers turn and mirror meshes, each in
    /// its own way; where the joints rest tells how, whatever units and whatever person.
    /// </summary>
    public sealed class BodyAxes
    {
        static readonly int[][] Orders =
        {
            new[] { 0, 1, 2 }, new[] { 1, 2, 0 }, new[] { 2, 0, 1 },  // even
            new[] { 0, 2, 1 }, new[] { 1, 0, 2 }, new[] { 2, 1, 0 },  // odd
        };

        readonly int[] axis;
        readonly float[] sign;
        readonly float handed;

        BodyAxes(int[] axis, float[] sign, float handed)
        {
            this.axis = axis;
            this.sign = sign;
            this.handed = handed;
        }

        /// <summary>From joints in the mesh's space and the same joints in the body's.</summary>
        public static BodyAxes Find(Vector3[] mesh, Vector3[] body)
        {
            Vector3 meshMiddle = Middle(mesh), bodyMiddle = Middle(body);
            var together = new float[3, 3];
            for (int k = 0; k < mesh.Length; k++)
                for (int a = 0; a < 3; a++)
                    for (int b = 0; b < 3; b++)
                        together[a, b] += (mesh[k][a] - meshMiddle[a]) * (body[k][b] - bodyMiddle[b]);
            int best = 0;
            float most = -1;
            for (int k = 0; k < Orders.Length; k++)
            {
                float sum = 0;
                for (int b = 0; b < 3; b++)
                    sum += Math.Abs(together[Orders[k][b], b]);
                if (sum > most)
                {
                    most = sum;
                    best = k;
                }
            }
            var sign = new float[3];
            float handed = best < 3 ? 1 : -1;
            for (int b = 0; b < 3; b++)
            {
                sign[b] = together[Orders[best][b], b] < 0 ? -1 : 1;
                handed *= sign[b];
            }
            return new BodyAxes(Orders[best], sign, handed);
        }

        /// <summary>A rotation in the mesh's axes, in the body's: its axis turns, and a mirror turns it the other way.</summary>
        public Quaternion ToBody(Quaternion turn)
        {
            return new Quaternion(
                handed * sign[0] * turn[axis[0]], handed * sign[1] * turn[axis[1]], handed * sign[2] * turn[axis[2]], turn.w);
        }

        static Vector3 Middle(Vector3[] points)
        {
            var sum = new Vector3(0, 0, 0);
            foreach (var point in points)
                sum += point;
            return sum / points.Length;
        }
    }
}
